/* The link layer: CRC, COBS, and frames in a stream of bytes (PROTOCOL.md, section 2). Pure C
 * without registers or a clock. */
#ifndef LINK_H
#define LINK_H

#include <stdint.h>

#include "wire.h"

/* A message in either direction. */
struct link_frame {
    uint8_t type;
    uint16_t sequence;
    uint8_t payload_length;
    uint8_t payload[MAX_PAYLOAD_BYTES];
};

/* The bytes since the last delimiter. A receiver begins with all members 0; a `length` beyond the
 * buffer marks a frame that is too long or has lost a byte. */
struct link_receiver {
    uint8_t length;
    uint8_t encoded[MAX_FRAME_BYTES - 1];
};

enum link_event { LINK_NOTHING, LINK_FRAME, LINK_DROPPED };

/* Takes one byte. It returns LINK_FRAME if the byte ended a frame, which `frame` then holds, and
 * LINK_DROPPED if it ended bytes that are no frame. */
enum link_event link_receive(struct link_receiver *receiver, uint8_t byte,
                             struct link_frame *frame);

/* Marks the current frame, of which a byte was lost, so that its end drops it. */
void link_lose_byte(struct link_receiver *receiver);

/* Encodes a frame with its closing 0x00; returns the number of bytes. */
uint8_t link_encode(const struct link_frame *frame, uint8_t bytes[MAX_FRAME_BYTES]);

/* Little-endian fields. */
void put_u16(uint8_t *bytes, uint16_t value);
void put_u32(uint8_t *bytes, uint32_t value);
uint16_t get_u16(const uint8_t *bytes);
uint32_t get_u32(const uint8_t *bytes);

#endif
