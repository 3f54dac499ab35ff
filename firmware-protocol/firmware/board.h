/* What the program needs of a board: another board is another file that implements this. */
#ifndef BOARD_H
#define BOARD_H

#include <stdbool.h>
#include <stdint.h>

#include "qube_frame.h"

/* One of `enum device_kind`. */
extern const uint8_t BOARD_KIND;

/* Serial port, SPI, clock and interrupts. The hardware watchdog runs from here on. */
void board_start(void);

/* Microseconds since the start, modulo 2^32. */
uint32_t board_time_us(void);

/* Whether a sampling period has begun since it was asked last. */
bool board_sampling_is_due(void);

/* A number that no start of this board has had before; kept over power-off. */
uint16_t board_next_boot_number(void);

/* Takes a byte that has arrived. */
bool board_receive(uint8_t *byte);
/* Whether bytes were lost since it was asked last. */
bool board_lost_bytes(void);
/* How many bytes can be sent without waiting. */
uint8_t board_send_room(void);
void board_send(const uint8_t *bytes, uint8_t length);

/* The frame to the Qube: one at a time, moved by interrupts, chip select low throughout. It is busy
 * from its begin until `board_qube_ended` has told of its end. Returns when chip select fell. */
bool board_qube_is_busy(void);
uint32_t board_qube_begin(const uint8_t command[QUBE_FRAME_BYTES]);
/* Whether a frame has ended since it was asked last, and what came with it. */
bool board_qube_ended(uint8_t answer[QUBE_FRAME_BYTES]);

/* The chip's own watchdog: without this for 16 ms it switches the motor off and restarts. */
void board_feed_hardware_watchdog(void);

/* Sleeps unless an interrupt has struck since the last call. */
void board_sleep(void);

#endif
