#include "modbus.h"

#include <string.h>

#include "board.h"

#define READ_HOLDING 3u
#define WRITE_SINGLE 6u
#define WRITE_MULTIPLE 16u
#define READ_WRITE 23u
#define ILLEGAL_FUNCTION 1u
#define EXCEPTION_FLAG 0x80u

#define READ_MAX 125u
#define WRITE_MAX 123u
#define READ_WRITE_MAX 121u

static uint16_t word_of(const uint8_t *at)
{
    return (uint16_t)(((uint32_t)at[0] << 8) | (uint32_t)at[1]);
}

/* Words into an answer after its function code: their bytes, then themselves. */
static size_t say_words(const uint16_t *words, uint32_t count, uint8_t *answer)
{
    answer[1] = (uint8_t)(2u * count);
    for (uint32_t i = 0u; i < count; i++) {
        answer[2u + (2u * i)] = (uint8_t)(words[i] >> 8);
        answer[3u + (2u * i)] = (uint8_t)(words[i] & 0xFFu);
    }
    return 2u + (2u * (size_t)count);
}

static enum board_answer read_words(const uint8_t *at, uint16_t *words)
{
    const uint32_t count = word_of(&at[2]);
    if ((count < 1u) || (count > READ_MAX)) {
        return BOARD_VALUE;
    }
    return board_read(word_of(at), count, words);
}

/* Address, count, bytes and words of a request for function codes 16 and 23; their length must be right. */
static enum board_answer take_words(const uint8_t *at, size_t length, uint32_t most, uint16_t *words)
{
    if (length < 5u) {
        return BOARD_VALUE;
    }
    const uint32_t count = word_of(&at[2]);
    if ((count < 1u) || (count > most) || ((uint32_t)at[4] != (2u * count)) || (length != (5u + (2u * (size_t)count)))) {
        return BOARD_VALUE;
    }
    for (uint32_t i = 0u; i < count; i++) {
        words[i] = word_of(&at[5u + (2u * i)]);
    }
    return BOARD_DONE;
}

static enum board_answer read_holding(const uint8_t *request, size_t length, uint8_t *answer, size_t *said)
{
    uint16_t words[READ_MAX];
    const enum board_answer result = (length == 5u) ? read_words(&request[1], words) : BOARD_VALUE;
    if (result == BOARD_DONE) {
        *said = say_words(words, word_of(&request[3]), answer);
    }
    return result;
}

static enum board_answer write_single(const uint8_t *request, size_t length, uint8_t *answer, size_t *said)
{
    if (length != 5u) {
        return BOARD_VALUE;
    }
    const uint16_t word = word_of(&request[3]);
    const enum board_answer result = board_write(word_of(&request[1]), 1u, &word);
    (void)memcpy(&answer[1], &request[1], 4u);
    *said = 5u;
    return result;
}

static enum board_answer write_multiple(const uint8_t *request, size_t length, uint8_t *answer, size_t *said)
{
    uint16_t words[WRITE_MAX];
    enum board_answer result = take_words(&request[1], length - 1u, WRITE_MAX, words);
    if (result == BOARD_DONE) {
        result = board_write(word_of(&request[1]), word_of(&request[3]), words);
        (void)memcpy(&answer[1], &request[1], 4u);
        *said = 5u;
    }
    return result;
}

/* Refused as a whole: a wrong read writes nothing. */
static enum board_answer read_write(const uint8_t *request, size_t length, uint8_t *answer, size_t *said)
{
    uint16_t written[READ_WRITE_MAX];
    uint16_t words[READ_MAX];
    if (length < 5u) {
        return BOARD_VALUE;
    }
    enum board_answer result = take_words(&request[5], length - 5u, READ_WRITE_MAX, written);
    if (result == BOARD_DONE) {
        result = read_words(&request[1], words);
    }
    if (result == BOARD_DONE) {
        result = board_write(word_of(&request[5]), word_of(&request[7]), written);
    }
    if (result == BOARD_DONE) {
        result = read_words(&request[1], words);
        *said = say_words(words, word_of(&request[3]), answer);
    }
    return result;
}

size_t modbus_respond(const uint8_t *request, size_t length, uint8_t *answer)
{
    uint32_t refusal = ILLEGAL_FUNCTION;
    size_t said = 2u;
    answer[0] = request[0];
    switch (request[0]) {
    case READ_HOLDING:
        refusal = (uint32_t)read_holding(request, length, answer, &said);
        break;
    case WRITE_SINGLE:
        refusal = (uint32_t)write_single(request, length, answer, &said);
        break;
    case WRITE_MULTIPLE:
        refusal = (uint32_t)write_multiple(request, length, answer, &said);
        break;
    case READ_WRITE:
        refusal = (uint32_t)read_write(request, length, answer, &said);
        break;
    default:
        break;
    }
    if (refusal != 0u) {
        answer[0] = (uint8_t)(request[0] | EXCEPTION_FLAG);
        answer[1] = (uint8_t)refusal;
        said = 2u;
    }
    return said;
}
