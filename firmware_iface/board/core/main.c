/* The program of a port without an operating system. */
#include "board.h"
#include "hal.h"
#include "settings.h"

int main(void)
{
    hal_init();
    board_start();
    const struct settings *settings = board_settings();
    hal_start(settings->baud, (enum hal_parity)settings->parity);
    for (;;) {
        board_poll();
        hal_wait();
    }
}
