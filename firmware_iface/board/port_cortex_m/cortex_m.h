/* What the ports to a Cortex-M without an operating system share. */
#ifndef MEMBRANE_CORTEX_M_H
#define MEMBRANE_CORTEX_M_H

#include <stdbool.h>
#include <stdint.h>

#include "ring.h"

#define WORD(address) (*(volatile uint32_t *)(address))
#define AIRCR WORD(0xE000ED0Cu)      /* application interrupt and reset control, B3.2.6 */
#define AIRCR_RESET 0x05FA0004u      /* key, SYSRESETREQ */

/* A port's vectors: the first is `{.stack = interrupt_stack_top}`, the second start(), the others its interrupts, and
 * fault() wherever nothing is expected. */
union vector {
    uint32_t *stack;
    void (*handler)(void);
};

extern uint32_t interrupt_stack_top[];

/* Reset. */
void start(void);

/* Any fault, any interrupt that nobody expects: port_outputs_safe(), then a reset. */
void fault(void);

/* What the Modbus line's interrupt received, and whether a byte was lost. */
extern struct ring uart_received;
extern volatile bool uart_lost;

/* Of the port. Drives pump and vent to 0 without buffers or interrupts. */
void port_outputs_safe(void);

#endif
