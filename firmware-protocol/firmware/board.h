/* The interface between program and board. Each kind of board has a file that implements it. */
#ifndef BOARD_H
#define BOARD_H

#include <stdbool.h>
#include <stdint.h>

#include "qube_frame.h"

/* One of `enum device_kind`. */
extern const uint8_t BOARD_KIND;

/* Tells the Qube to switch its motor off; to be called before every other function. A program that
 * hung before this start, or a board that lost its supply, may have left a voltage there. */
void board_switch_qube_off(void);

/* Gives this board's own serial number, most significant byte first: drawn at random once, then
 * kept over power-off. May take 50 ms the first time; to be called before `board_start`. */
void board_serial(uint8_t serial[8]);

/* Starts serial port, SPI, clock and interrupts. The hardware watchdog runs from here on. */
void board_start(void);

/* Microseconds since the start, modulo 2^32. */
uint32_t board_time_us(void);

/* Returns whether a sampling period has begun since the last call that returned true. */
bool board_sampling_is_due(void);

/* Increments a 16-bit number in the EEPROM and returns it; it repeats after 65 536 calls. */
uint16_t board_next_boot_number(void);

/* The emergency-stop switch: the first function returns whether its contact is closed now, the
 * second whether the EEPROM says that this board has one; the third stores that it has one. */
bool board_stop_switch_is_closed(void);
bool board_stop_switch_is_known(void);
void board_remember_stop_switch(void);

/* Takes a byte that has arrived; returns false if there is none. `after_loss` becomes true if bytes
 * were lost between the last byte and this one, or if this byte arrived garbled. */
bool board_receive(uint8_t *byte, bool *after_loss);
/* Returns the number of bytes that can be sent without waiting. */
uint8_t board_send_room(void);
void board_send(const uint8_t *bytes, uint8_t length);

/* The frame to the Qube: one at a time, moved by interrupts, chip select low throughout. The Qube
 * is busy from `board_qube_begin`, which returns the time at which chip select fell, us, until
 * `board_qube_ended` has returned true. */
bool board_qube_is_busy(void);
uint32_t board_qube_begin(const uint8_t command[QUBE_FRAME_BYTES]);
/* Returns whether a frame has ended since the last call; if so, copies the Qube's answer. */
bool board_qube_ended(uint8_t answer[QUBE_FRAME_BYTES]);

/* Feeds the chip's own watchdog. If it is not fed for 16 ms, it switches the motor off, and 16 ms
 * later it restarts the chip. */
void board_feed_hardware_watchdog(void);

/* Sleeps until the next interrupt, or not at all if an interrupt since the last call may have left
 * work. */
void board_sleep(void);

#endif
