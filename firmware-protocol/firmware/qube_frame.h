/* The 17-byte SPI frame of the QUBE-Servo 2 Embedded panel, its scaling, and its 24-bit counters.
 * Pure C without registers or a clock.
 *
 * SPI mode 2, MSB first, 1 MHz, chip select low for the whole frame. Frame and scaling follow
 * Quanser's datasheet of the QFLEX 2 Embedded panel (2016). */
#ifndef QUBE_FRAME_H
#define QUBE_FRAME_H

#include <stdint.h>

#include "wire.h"

#define QUBE_FRAME_BYTES 17u

/* Write mask for motor, motor enable and the three LEDs. */
#define QUBE_WRITE_ALL 0x1Fu
/* The same mask with both encoder presets; with motor word 0x0000 it clears a stall error. */
#define QUBE_WRITE_ALL_AND_PRESETS 0x7Fu

/* Motor word of an amplifier that is off. */
#define MOTOR_OFF 0x0000u

/* Index of the motor word's first byte in a command. */
#define QUBE_MOTOR_BYTE 15u

/* Largest brightness of an LED. */
#define QUBE_LED_MAX 999u

/* Bits of the Qube's status byte. */
#define QUBE_AMPLIFIER_FAULT 0x01u
#define QUBE_STALL_DETECTED 0x02u
#define QUBE_STALL_ERROR 0x04u

struct qube_command {
    uint8_t write_mask;
    uint16_t red;
    uint16_t green;
    uint16_t blue;
    uint16_t motor_word;
};

struct qube_readings {
    uint16_t module_id;
    /* 24-bit counters as received. */
    uint32_t theta_raw;
    uint32_t alpha_raw;
    uint32_t tachometer_raw;
    uint16_t current_raw;
    uint8_t status;
};

void qube_frame_encode(const struct qube_command *command, uint8_t bytes[QUBE_FRAME_BYTES]);
void qube_frame_decode(const uint8_t bytes[QUBE_FRAME_BYTES], struct qube_readings *readings);

/* The byte to send at `index`; the answer is known up to there. The presets (bytes 9 to 14) repeat
 * the counts that this frame has brought (bytes 2 to 7). So where the write mask admits the
 * presets, the counters continue from their values, however fast the arm turns. */
static inline uint8_t qube_frame_byte(const uint8_t *command, const uint8_t *answer, uint8_t index)
{
    return index >= 9u && index < 15u ? answer[index - 7u] : command[index];
}

/* Extends a 24-bit reading of a counter to 32 bits. Correct if the counter moved by less than
 * 2^23 counts, 4096 revolutions, since the last reading. */
int32_t extend_counts(int32_t last, uint32_t raw);

/* Conversions between voltage and motor counts. */
int16_t motor_counts(int16_t voltage_mv);
int16_t motor_voltage_mv(int16_t counts);
/* The motor word of an amplifier that is on, and the voltage of any motor word. */
uint16_t motor_word(int16_t counts);
int16_t motor_word_mv(uint16_t word);

int16_t current_ma(uint16_t raw);
int32_t tachometer_counts_s(uint32_t raw);

#endif
