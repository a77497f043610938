/* What start.c needs of the port. */
#ifndef MEMBRANE_MPS2_H
#define MEMBRANE_MPS2_H

void mps2_uart0(void);
void mps2_uart1(void);
void mps2_timer0(void);

/* From a handler of faults: tells the film to stop the pump without buffers or interrupts. */
void mps2_outputs_safe(void);

#endif
