/* The link layer: CRC, COBS, and cutting a stream of bytes into frames (PROTOCOL.md, section 2).
 * Pure C: no registers, no clock. */
#ifndef LINK_H
#define LINK_H

#include <stdint.h>

#include "wire.h"

/* One message, in either direction. */
struct link_frame {
    uint8_t type;
    uint16_t sequence;
    uint8_t payload_length;
    uint8_t payload[MAX_PAYLOAD_BYTES];
};

/* What has arrived since the last delimiter. All zero at the start. */
struct link_receiver {
    uint8_t length;
    uint8_t encoded[MAX_FRAME_BYTES - 1];
};

enum link_event { LINK_NOTHING, LINK_FRAME, LINK_DROPPED };

/* Takes one byte; after LINK_FRAME, `frame` holds what ended with it. */
enum link_event link_receive(struct link_receiver *receiver, uint8_t byte,
                             struct link_frame *frame);

/* A byte was lost: what is being collected is no frame any more. */
void link_lose_byte(struct link_receiver *receiver);

/* Lays a frame out for the wire, its closing 0x00 included; returns how many bytes it has. */
uint8_t link_encode(const struct link_frame *frame, uint8_t bytes[MAX_FRAME_BYTES]);

/* Little-endian fields. */
void put_u16(uint8_t *bytes, uint16_t value);
void put_u32(uint8_t *bytes, uint32_t value);
uint16_t get_u16(const uint8_t *bytes);
uint32_t get_u32(const uint8_t *bytes);

#endif
