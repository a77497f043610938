/* Memory that the board decides by is kept twice, the second time inverted: a damaged word shows. */
#ifndef MEMBRANE_GUARD_H
#define MEMBRANE_GUARD_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

static inline bool guard_holds(const uint32_t *words, const uint32_t *inverse, size_t count)
{
    uint32_t damage = 0u;
    for (size_t i = 0u; i < count; i++) {
        damage |= words[i] ^ ~inverse[i];
    }
    return damage == 0u;
}

static inline void guard_seal(const uint32_t *words, uint32_t *inverse, size_t count)
{
    for (size_t i = 0u; i < count; i++) {
        inverse[i] = ~words[i];
    }
}

#endif
