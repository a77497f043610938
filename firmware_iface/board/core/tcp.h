/* Modbus TCP over a network stack of four functions (Modbus messaging on TCP/IP 1.0b). */
#ifndef MEMBRANE_TCP_H
#define MEMBRANE_TCP_H

#include <stddef.h>
#include <stdint.h>

#define TCP_CLIENTS 4u
#define TCP_NONE (-1)

/* The stack. None of them may wait. A connection is a number from 0. */
struct network {
    int (*accept)(void);                                             /* a new connection, or TCP_NONE */
    int (*receive)(int connection, uint8_t *bytes, size_t room);     /* bytes taken, 0: none now, below 0: it is closed */
    int (*send)(int connection, const uint8_t *bytes, size_t count); /* below 0: cannot send all of it */
    void (*close)(int connection);
};

/* Power-up: no connections. */
void tcp_start(void);

/* Accepts connections and answers what has arrived. A client beyond the fourth takes the place of the longest idle. */
void tcp_poll(const struct network *network, uint32_t unit_id);

#endif
