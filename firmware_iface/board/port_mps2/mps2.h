/* The handlers of the port. */
#ifndef MEMBRANE_MPS2_H
#define MEMBRANE_MPS2_H

void mps2_uart0(void);
void mps2_uart1(void);
void mps2_timer0(void);

#endif
