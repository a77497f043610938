/* The stream of a Micro-Epsilon optoNCDT 1420 with OUTPUT RS422 and OUTADD_RS422 COUNTER stored in the sensor: three bytes
 * for the distance, three for a counter, six bits in each byte (optoNCDT 1420 manual, 7.5.2). A distance counts only
 * if the counter after it is the next one: lost bytes then give no value instead of a false one. */
#include "hal.h"
#include "stm32f4.h"

#define STALE_US 100000u
#define RAW_MAX 65520u
#define ERRORS_BELOW 262072u /* the sensor's codes 262073.. become 1.. */
#define COUNTS 0x3FFFFu
#define SUMMED_MAX 256u /* half a second: far more than fits between two samples */

static struct {
    uint32_t words[2]; /* distance, counter; 18 bits each */
    uint32_t part;     /* bytes taken of the six; 6: waiting for a first byte */
    uint32_t counter;
    uint32_t sum, count; /* of good distances since the last sample */
    uint32_t heard_us;
    int32_t newest, quality;
} laser = {.part = 6u, .newest = HAL_NO_VALUE, .quality = 1};

static void measured(uint32_t now_us)
{
    const uint32_t counter = laser.words[1];
    const bool next = counter == ((laser.counter + 1u) & COUNTS);
    laser.counter = counter;
    if (next) {
        laser.heard_us = now_us;
        if (laser.words[0] > RAW_MAX) {
            laser.quality = (laser.words[0] > ERRORS_BELOW) ? (int32_t)(laser.words[0] - ERRORS_BELOW) : 1;
        } else if (laser.count < SUMMED_MAX) {
            laser.sum += laser.words[0];
            laser.count++;
            laser.quality = 0;
        } else {
            /* nobody fetches */
        }
    }
}

void laser_take(uint8_t byte, uint32_t now_us)
{
    static const uint8_t MARKS[6] = {0x00u, 0x40u, 0x80u, 0x00u, 0x40u, 0xC0u};
    const uint8_t mark = byte & 0xC0u;
    if ((laser.part < 6u) && (mark == MARKS[laser.part])) {
        laser.words[laser.part / 3u] |= (uint32_t)(byte & 0x3Fu) << (6u * (laser.part % 3u));
        laser.part++;
        if (laser.part == 6u) {
            measured(now_us);
        }
    } else {
        laser.part = 6u; /* out of step: begin with the next first byte */
    }
    if ((laser.part == 6u) && ((mark == 0xC0u) || (mark == 0x00u))) {
        laser.part = (mark == 0x00u) ? 1u : 0u;
        laser.words[0] = (mark == 0x00u) ? (uint32_t)byte : 0u;
        laser.words[1] = 0u;
    }
}

int32_t laser_displacement(uint32_t now_us)
{
    const uint32_t before = hal_lock();
    if (laser.count > 0u) {
        laser.newest = (int32_t)((16u * laser.sum) / laser.count);
        laser.sum = 0u;
        laser.count = 0u;
    }
    if ((now_us - laser.heard_us) > STALE_US) {
        laser.quality = 1; /* until a value comes, also when the clock wraps */
    }
    const int32_t found = (laser.quality == 0) ? laser.newest : HAL_NO_VALUE;
    hal_unlock(before);
    return found;
}

int32_t laser_quality(void)
{
    return laser.quality;
}
