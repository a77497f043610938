/* Requests to answers: function codes 3, 6, 16 and 23 on the board's registers (Modbus application protocol 1.1b3). */
#ifndef MEMBRANE_MODBUS_H
#define MEMBRANE_MODBUS_H

#include <stddef.h>
#include <stdint.h>

#define MODBUS_PDU_MAX 253u

/* Carries out a request of 1..MODBUS_PDU_MAX bytes; returns the length of the answer, which has the same room. */
size_t modbus_respond(const uint8_t *request, size_t length, uint8_t *answer);

#endif
