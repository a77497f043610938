/* A queue of bytes between the main loop and an interrupt. */
#ifndef MEMBRANE_RING_H
#define MEMBRANE_RING_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define RING 512u /* a power of two: a damaged index still points into it */

struct ring {
    uint8_t bytes[RING];
    volatile uint32_t put, got;
};

static inline bool ring_empty(const struct ring *ring)
{
    const uint32_t put = ring->put;
    return put == ring->got;
}

static inline bool ring_put(struct ring *ring, uint8_t byte)
{
    const uint32_t put = ring->put;
    const bool room = (put - ring->got) < RING;
    if (room) {
        ring->bytes[put % RING] = byte;
        ring->put = put + 1u;
    }
    return room;
}

/* All bytes or none. */
static inline void ring_put_all(struct ring *ring, const uint8_t *bytes, size_t count)
{
    const uint32_t put = ring->put;
    if ((RING - (put - ring->got)) >= count) {
        for (size_t i = 0u; i < count; i++) {
            (void)ring_put(ring, bytes[i]);
        }
    }
}

/* The oldest byte of a ring that is not empty. */
static inline uint8_t ring_get(struct ring *ring)
{
    const uint32_t got = ring->got;
    ring->got = got + 1u;
    return ring->bytes[got % RING];
}

#endif
