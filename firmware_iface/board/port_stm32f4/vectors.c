/* RM0390 table 38. A falling supply (PVD) and a failed clock (NMI) are faults. */
#include "stm32f4.h"

#define F {.handler = fault}
#define F8 F, F, F, F, F, F, F, F
#define H(name) {.handler = name}

__attribute__((section(".vectors"), used)) static const union vector VECTORS[16 + 104] = {
    {.stack = interrupt_stack_top}, H(start), F, F, F, F, F, F,
    F, F, F, F, F, F, F, H(stm32_tick),
    F8, F8, F8, F8, F, F, F, F, F, H(stm32_usart1), H(stm32_usart2), F, /* interrupts 0..39 */
    F8, F8, F8, F8, F8, F8, F8, F8,
};
