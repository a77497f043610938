/* Reset and faults of a Cortex-M3 or M4 (ARMv7-M architecture reference manual, DDI 0403). */
#include "cortex_m.h"
#include "hal.h"

#define MPU_CTRL WORD(0xE000ED94u)   /* B3.5.5 */
#define MPU_RBAR WORD(0xE000ED9Cu)
#define MPU_RASR WORD(0xE000EDA0u)
#define MPU_ON_BESIDE_DEFAULT 5u     /* PRIVDEFENA, ENABLE: what no region covers is as without an MPU */
#define MPU_NO_ACCESS_32_BYTES 0x10000009u /* XN, AP 000, size 2^(4+1), on */

extern uint32_t data_start[], data_end[], bss_start[], bss_end[], main_stack_top[];
extern const uint32_t data_stored[];
extern uint32_t main_stack_guard[];

int main(void);

void fault(void)
{
    hal_reset();
}

static void fault_guard(void)
{
    MPU_RBAR = (uint32_t)main_stack_guard | 0x10u; /* region 0 */
    MPU_RASR = MPU_NO_ACCESS_32_BYTES;
    MPU_CTRL = MPU_ON_BESIDE_DEFAULT;
    __asm volatile("dsb\n isb" ::: "memory");
}

static void prepare(void)
{
    const uint32_t *from = data_stored;
    for (uint32_t *to = data_start; to < data_end; to++) {
        *to = *from;
        from++;
    }
    for (uint32_t *to = bss_start; to < bss_end; to++) {
        *to = 0u;
    }
    fault_guard();
    (void)main();
    fault();
}

/* The main loop gets its own stack, so that handlers still have theirs when it overflows. */
__attribute__((naked)) void start(void)
{
    __asm volatile("ldr r0, =main_stack_top\n"
                   "msr psp, r0\n"
                   "movs r0, #2\n"
                   "msr control, r0\n"
                   "isb\n"
                   "bl %0\n" ::"i"(prepare));
}
