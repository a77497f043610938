#include "tcp.h"

#include <stdbool.h>
#include <string.h>

#include "hal.h"
#include "modbus.h"

#define HEADER 7u /* transaction, protocol, length of what follows, unit */
#define FRAME_MAX (HEADER + MODBUS_PDU_MAX)
#define NO_RESPONSE 11u /* of a gateway: there is no such unit behind it */

struct client {
    int connection;
    uint32_t heard_us;
    size_t count;
    uint8_t bytes[FRAME_MAX];
};

static struct client clients[TCP_CLIENTS];

void tcp_start(void)
{
    for (uint32_t i = 0u; i < TCP_CLIENTS; i++) {
        clients[i].connection = TCP_NONE;
    }
}

static void hang_up(struct client *client, const struct network *network)
{
    network->close(client->connection);
    client->connection = TCP_NONE;
}

static void admit(const struct network *network)
{
    const int connection = network->accept();
    if (connection == TCP_NONE) {
        return;
    }
    struct client *place = &clients[0];
    const uint32_t now_us = hal_micros();
    for (uint32_t i = 0u; (i < TCP_CLIENTS) && (place->connection != TCP_NONE); i++) {
        if ((clients[i].connection == TCP_NONE) || ((now_us - clients[i].heard_us) > (now_us - place->heard_us))) {
            place = &clients[i];
        }
    }
    if (place->connection != TCP_NONE) {
        hang_up(place, network);
    }
    place->connection = connection;
    place->heard_us = now_us;
    place->count = 0u;
}

/* The length of the first request in the buffer; 0 while it is incomplete, above FRAME_MAX if it is not Modbus. */
static size_t request_length(const struct client *client)
{
    size_t whole = 0u;
    if (client->count >= HEADER) {
        const uint8_t *head = client->bytes;
        const size_t length = ((size_t)head[4] << 8) | (size_t)head[5];
        const bool modbus = (head[2] == 0u) && (head[3] == 0u) && (length >= 2u) && (length <= (MODBUS_PDU_MAX + 1u));
        whole = modbus ? (length + HEADER - 1u) : (FRAME_MAX + 1u);
    }
    return ((whole > client->count) && (whole <= FRAME_MAX)) ? 0u : whole;
}

static bool answer_request(const struct client *client, size_t whole, const struct network *network, uint32_t unit_id)
{
    static uint8_t frame[FRAME_MAX];
    const uint8_t *pdu = &client->bytes[HEADER];
    size_t said = 2u;
    (void)memcpy(frame, client->bytes, HEADER);
    if ((uint32_t)client->bytes[6] == unit_id) {
        said = modbus_respond(pdu, whole - HEADER, &frame[HEADER]);
    } else {
        frame[HEADER] = (uint8_t)(pdu[0] | 0x80u);
        frame[HEADER + 1u] = NO_RESPONSE;
    }
    frame[4] = 0u;
    frame[5] = (uint8_t)(said + 1u);
    return network->send(client->connection, frame, HEADER + said) >= 0;
}

static void serve(struct client *client, const struct network *network, uint32_t unit_id)
{
    const size_t room = (client->count < FRAME_MAX) ? (FRAME_MAX - client->count) : 0u;
    const int got = network->receive(client->connection, &client->bytes[FRAME_MAX - room], room);
    bool good = (got >= 0) && (room > 0u);
    if (got > 0) {
        client->count += (size_t)got;
        client->heard_us = hal_micros();
    }
    size_t whole = request_length(client);
    while (good && (whole != 0u)) {
        good = (whole <= FRAME_MAX) && answer_request(client, whole, network, unit_id);
        if (good) {
            client->count -= whole;
            (void)memmove(client->bytes, &client->bytes[whole], client->count);
            whole = request_length(client);
        }
    }
    if (!good) {
        hang_up(client, network);
    }
}

void tcp_poll(const struct network *network, uint32_t unit_id)
{
    admit(network);
    for (uint32_t i = 0u; i < TCP_CLIENTS; i++) {
        if (clients[i].connection != TCP_NONE) {
            serve(&clients[i], network, unit_id);
        }
    }
}
