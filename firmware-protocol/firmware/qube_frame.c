#include "qube_frame.h"

#include <string.h>

static void put_be16(uint8_t *bytes, uint16_t value)
{
    bytes[0] = (uint8_t)(value >> 8);
    bytes[1] = (uint8_t)value;
}

static uint16_t get_be16(const uint8_t *bytes)
{
    return (uint16_t)(((uint16_t)bytes[0] << 8) | bytes[1]);
}

static uint32_t get_be24(const uint8_t *bytes)
{
    return ((uint32_t)bytes[0] << 16) | get_be16(bytes + 1);
}

void qube_frame_encode(const struct qube_command *command, uint8_t bytes[QUBE_FRAME_BYTES])
{
    memset(bytes, 0, QUBE_FRAME_BYTES);
    bytes[0] = 1; /* the full frame, not the two identity bytes alone */
    bytes[2] = command->write_mask;
    put_be16(bytes + 3, command->red);
    put_be16(bytes + 5, command->green);
    put_be16(bytes + 7, command->blue);
    put_be16(bytes + QUBE_MOTOR_BYTE, command->motor_word);
}

void qube_frame_decode(const uint8_t bytes[QUBE_FRAME_BYTES], struct qube_readings *readings)
{
    readings->module_id = get_be16(bytes);
    readings->theta_raw = get_be24(bytes + 2);
    readings->alpha_raw = get_be24(bytes + 5);
    readings->tachometer_raw = get_be24(bytes + 8);
    readings->status = bytes[11];
    readings->current_raw = get_be16(bytes + 12);
}

int32_t extend_counts(int32_t last, uint32_t raw)
{
    uint32_t moved = (raw - (uint32_t)last) & 0xFFFFFFu;
    if (moved & 0x800000u) {
        moved |= 0xFF000000u;
    }
    return (int32_t)((uint32_t)last + moved);
}

/* Rounds to nearest, halves away from zero; `denominator` is above 0. */
static int16_t round_divide(int32_t numerator, int32_t denominator)
{
    int32_t half = denominator / 2;
    return (int16_t)((numerator >= 0 ? numerator + half : numerator - half) / denominator);
}

int16_t motor_counts(int16_t voltage_mv)
{
    return round_divide((int32_t)voltage_mv * FULL_MOTOR_COUNTS, SUPPLY_MV);
}

int16_t motor_voltage_mv(int16_t counts)
{
    return round_divide((int32_t)counts * SUPPLY_MV, FULL_MOTOR_COUNTS);
}

uint16_t motor_word(int16_t counts)
{
    return MOTOR_ENABLE | ((uint16_t)counts & 0x7FFFu);
}

int16_t motor_word_mv(uint16_t word)
{
    if (!(word & MOTOR_ENABLE)) {
        return 0;
    }
    /* Bit 14 is the sign of the 15 bits below the enable bit. */
    uint16_t counts = word & 0x7FFFu;
    return motor_voltage_mv((int16_t)(counts & 0x4000u ? counts | 0x8000u : counts));
}

int16_t current_ma(uint16_t raw)
{
    return round_divide(((int32_t)raw - CURRENT_ZERO) * 1000, CURRENT_COUNTS_PER_A);
}

int32_t tachometer_counts_s(uint32_t raw)
{
    uint32_t ticks = raw & TACHOMETER_TICKS;
    if (ticks == TACHOMETER_STILL || ticks == 0) {
        return 0;
    }
    int32_t speed = (int32_t)(TACHOMETER_COUNTS_S_TICKS / ticks);
    return raw & TACHOMETER_NEGATIVE ? -speed : speed;
}
