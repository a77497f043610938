/* The part of hal.h that every Cortex-M has (ARMv7-M architecture reference manual, DDI 0403). */
#include "cortex_m.h"
#include "hal.h"

struct ring uart_received;
volatile bool uart_lost;

void hal_reset(void)
{
    port_outputs_safe();
    AIRCR = AIRCR_RESET;
    for (;;) {
    }
}

void hal_wait(void)
{
    __asm volatile("wfi" ::: "memory");
}

uint32_t hal_lock(void)
{
    uint32_t before;
    __asm volatile("mrs %0, primask\n cpsid i" : "=r"(before)::"memory");
    return before;
}

void hal_unlock(uint32_t before)
{
    __asm volatile("msr primask, %0" ::"r"(before) : "memory");
}

int hal_uart_read(void)
{
    int found = HAL_UART_EMPTY;
    if (uart_lost) {
        uart_lost = false;
        found = HAL_UART_ERROR;
    } else if (!ring_empty(&uart_received)) {
        found = ring_get(&uart_received);
    } else {
        /* nothing */
    }
    return found;
}
