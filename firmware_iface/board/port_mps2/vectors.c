/* The interrupts of AN385. The watchdog's first warning is the NMI, a fault. */
#include "cortex_m.h"
#include "mps2.h"

#define F {.handler = fault}
#define H(name) {.handler = name}

__attribute__((section(".vectors"), used)) static const union vector VECTORS[16 + 32] = {
    {.stack = interrupt_stack_top}, H(start), F, F, F, F, F, F,
    F, F, F, F, F, F, F, F,
    H(mps2_uart0), H(mps2_uart0), H(mps2_uart1), H(mps2_uart1), F, F, F, F,
    H(mps2_timer0), F, F, F, F, F, F, F,
    F, F, F, F, F, F, F, F,
    F, F, F, F, F, F, F, F,
};
