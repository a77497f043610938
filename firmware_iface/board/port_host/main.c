/* The board as a program on a PC: Modbus RTU on a pseudo terminal, Modbus TCP on a port of localhost, and the wire to a
 * simulated film (bench_line.h) to a port that listens. Prints the line's name and the TCP port, then runs until it is
 * stopped. */
#define _GNU_SOURCE

#include <arpa/inet.h>
#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#include "bench_line.h"
#include "board.h"
#include "settings.h"
#include "tcp.h"
#include "virtual.h"

static int listener = -1; /* of Modbus TCP */
static volatile sig_atomic_t told_to_stop;

static void give_up(const char *what)
{
    fprintf(stderr, "board: %s: %s\n", what, strerror(errno));
    exit(4);
}

static uint64_t clock_us(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec * 1000000u + (uint64_t)now.tv_nsec / 1000u;
}

static struct sockaddr_in localhost(uint16_t port)
{
    const struct sockaddr_in at = {
        .sin_family = AF_INET, .sin_port = htons(port), .sin_addr.s_addr = htonl(INADDR_LOOPBACK)};
    return at;
}

static uint16_t listen_on_any_port(void)
{
    struct sockaddr_in at = localhost(0);
    socklen_t length = sizeof at;
    listener = socket(AF_INET, SOCK_STREAM | SOCK_NONBLOCK, 0);
    if (listener < 0 || bind(listener, (struct sockaddr *)&at, sizeof at) < 0 || listen(listener, 4) < 0 ||
        getsockname(listener, (struct sockaddr *)&at, &length) < 0) {
        give_up("cannot listen on localhost");
    }
    return ntohs(at.sin_port);
}

static int net_accept(void)
{
    const int found = accept4(listener, NULL, NULL, SOCK_NONBLOCK);
    return found < 0 ? TCP_NONE : found;
}

static int net_receive(int connection, uint8_t *bytes, size_t room)
{
    const ssize_t got = recv(connection, bytes, room, 0);
    if (got > 0) {
        return (int)got;
    }
    return got < 0 && (errno == EAGAIN || errno == EINTR) ? 0 : -1;
}

static int net_send(int connection, const uint8_t *bytes, size_t count)
{
    return send(connection, bytes, count, MSG_NOSIGNAL) == (ssize_t)count ? 0 : -1;
}

static void net_close(int connection)
{
    close(connection);
}

static const struct network NETWORK = {net_accept, net_receive, net_send, net_close};

static int open_line(char *name, size_t room)
{
    const int line = posix_openpt(O_RDWR | O_NOCTTY | O_NONBLOCK);
    struct termios raw;
    if (line < 0 || grantpt(line) < 0 || unlockpt(line) < 0 || ptsname_r(line, name, room) != 0 ||
        tcgetattr(line, &raw) < 0) {
        give_up("cannot open a pseudo terminal");
    }
    cfmakeraw(&raw);
    tcsetattr(line, TCSANOW, &raw);
    if (open(name, O_RDWR | O_NOCTTY) < 0) { /* kept open, so that the line outlives its clients */
        give_up(name);
    }
    return line;
}

static void move_line(int line)
{
    uint8_t bytes[512];
    const ssize_t got = read(line, bytes, sizeof bytes);
    if (got > 0) {
        virtual_hear(bytes, (size_t)got);
    }
}

static void say_line(int line)
{
    uint8_t bytes[512];
    const size_t said = virtual_said(bytes, sizeof bytes);
    if (said > 0u && write(line, bytes, said) != (ssize_t)said) {
        fprintf(stderr, "board: nobody reads the line; an answer is lost\n");
    }
}

static struct {
    int connection; /* to the film; -1 without one */
    uint64_t heard_us, said_us;
    uint32_t pump, vent;
    bool wired; /* to a film, even if its connection is lost by now */
    struct bench_line line;
} film = {.connection = -1};

static void film_connect(const char *port)
{
    const struct sockaddr_in at = localhost((uint16_t)strtoul(port, NULL, 10));
    film.connection = socket(AF_INET, SOCK_STREAM, 0);
    if (film.connection < 0 || connect(film.connection, (const struct sockaddr *)&at, sizeof at) < 0 ||
        fcntl(film.connection, F_SETFL, O_NONBLOCK) < 0) {
        give_up("no film on this port");
    }
    film.wired = true;
}

/* Without a film the board sits on a bench: flat film, still air, every interlock closed. */
static void bench_at_rest(void)
{
    static const int32_t RAWS[HAL_INPUT_CHANNELS] = {0, 0, 101325000, 210000, 210000, 0};
    for (int channel = 0; channel < HAL_INPUT_CHANNELS; channel++) {
        virtual_set_input(channel, RAWS[channel]);
    }
    virtual_set_interlocks(0xFFFFu);
}

static void film_hear(uint64_t now_us)
{
    uint8_t bytes[4096];
    const ssize_t got = film.connection < 0 ? 0 : recv(film.connection, bytes, sizeof bytes, 0);
    for (ssize_t i = 0; i < got; i++) {
        if (bench_take(&film.line, bytes[i])) {
            film.heard_us = now_us;
            virtual_set_interlocks((uint32_t)film.line.numbers[BENCH_INTERLOCKS]);
            for (int channel = 0; channel < HAL_INPUT_CHANNELS; channel++) {
                virtual_set_input(channel, (int32_t)film.line.numbers[channel]);
            }
        }
    }
    if (film.wired && now_us - film.heard_us > BENCH_STALE_US) {
        virtual_set_interlocks(0u);
        for (int channel = 0; channel < HAL_INPUT_CHANNELS; channel++) {
            virtual_set_input(channel, HAL_NO_VALUE);
        }
    }
}

static void film_say(uint64_t now_us)
{
    uint8_t text[BENCH_SAID_MAX];
    const uint32_t pump = virtual_pump(), vent = virtual_vent();
    if (film.connection < 0 || (pump == film.pump && vent == film.vent && now_us - film.said_us < 5000u)) {
        return;
    }
    const size_t said = bench_say(pump, vent, text);
    if (send(film.connection, text, said, MSG_NOSIGNAL) != (ssize_t)said) {
        close(film.connection);
        film.connection = -1;
    }
    film.pump = pump;
    film.vent = vent;
    film.said_us = now_us;
}

static void stop(int number)
{
    (void)number;
    told_to_stop = 1;
}

static void run(int line)
{
    uint64_t before_us = clock_us();
    while (!told_to_stop) {
        struct pollfd wakers[] = {{line, POLLIN, 0}, {listener, POLLIN, 0}, {film.connection, POLLIN, 0}};
        poll(wakers, 3, 1);
        const uint64_t now_us = clock_us();
        film_hear(now_us);
        move_line(line);
        virtual_pass((uint32_t)(now_us - before_us), true, true);
        before_us = now_us;
        tcp_poll(&NETWORK, board_settings()->unit_id);
        say_line(line);
        film_say(now_us);
    }
}

int main(int count, char **arguments)
{
    static uint8_t record[512];
    char name[64];
    if (count != 2 && count != 3) {
        fprintf(stderr, "usage: board SETTINGS [FILM_PORT] (settings: python -m firmware_iface.board_settings)\n");
        return 2;
    }
    FILE *file = fopen(arguments[1], "rb");
    if (file == NULL) {
        give_up(arguments[1]);
    }
    const size_t length = fread(record, 1u, sizeof record, file);
    fclose(file);
    signal(SIGTERM, stop);
    signal(SIGINT, stop);
    const uint16_t port = listen_on_any_port();
    if (count == 3) {
        film_connect(arguments[2]);
    }
    const int line = open_line(name, sizeof name);
    tcp_start();
    virtual_power_on(record, length);
    if (!film.wired) {
        bench_at_rest();
    }
    printf("rtu %s tcp %u\n", name, port);
    fflush(stdout);
    run(line);
    return 0;
}
