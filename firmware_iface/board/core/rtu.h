/* Modbus RTU: frames between silences, CRC, unit id, broadcast, return query data (Modbus over serial line 1.02). */
#ifndef MEMBRANE_RTU_H
#define MEMBRANE_RTU_H

#include "settings.h"

/* Power-up: forgets what was heard. */
void rtu_start(void);

/* Takes the bytes that have come; answers a frame once the line is silent after it. */
void rtu_poll(const struct settings *settings);

#endif
