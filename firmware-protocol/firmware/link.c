#include "link.h"

#include <string.h>

#define DELIMITER 0u
#define HEADER_BYTES 3u
#define CRC_BYTES 2u
#define MAX_ENCODED_BYTES (MAX_FRAME_BYTES - 1u)
#define MAX_BODY_BYTES (MAX_ENCODED_BYTES - 1u)

/* CRC-16/IBM-SDLC of the sixteen nibbles: two look-ups for each byte, and 32 bytes of table. */
static const uint16_t CRC_OF_NIBBLE[16] = {
    0x0000, 0x1081, 0x2102, 0x3183, 0x4204, 0x5285, 0x6306, 0x7387,
    0x8408, 0x9489, 0xA50A, 0xB58B, 0xC60C, 0xD68D, 0xE70E, 0xF78F,
};

static uint16_t crc_of(const uint8_t *bytes, uint8_t length)
{
    uint16_t crc = 0xFFFF;
    for (uint8_t i = 0; i < length; i++) {
        crc = (crc >> 4) ^ CRC_OF_NIBBLE[(crc ^ bytes[i]) & 0x0F];
        crc = (crc >> 4) ^ CRC_OF_NIBBLE[(crc ^ (bytes[i] >> 4)) & 0x0F];
    }
    return crc ^ 0xFFFF;
}

void put_u16(uint8_t *bytes, uint16_t value)
{
    bytes[0] = (uint8_t)value;
    bytes[1] = (uint8_t)(value >> 8);
}

void put_u32(uint8_t *bytes, uint32_t value)
{
    put_u16(bytes, (uint16_t)value);
    put_u16(bytes + 2, (uint16_t)(value >> 16));
}

uint16_t get_u16(const uint8_t *bytes)
{
    return (uint16_t)(bytes[0] | ((uint16_t)bytes[1] << 8));
}

uint32_t get_u32(const uint8_t *bytes)
{
    return get_u16(bytes) | ((uint32_t)get_u16(bytes + 2) << 16);
}

/* Decodes COBS; returns the length of the body, or 0 if the bytes are not COBS. */
static uint8_t uncobs(const uint8_t *encoded, uint8_t length, uint8_t body[MAX_BODY_BYTES])
{
    uint8_t read = 0;
    uint8_t written = 0;
    while (read < length) {
        uint8_t piece = encoded[read++];
        if (piece - 1u > (uint8_t)(length - read)) {
            return 0;
        }
        memcpy(body + written, encoded + read, piece - 1u);
        read += piece - 1u;
        written += piece - 1u;
        if (read < length) {
            body[written++] = 0;
        }
    }
    return written;
}

static enum link_event decode(const uint8_t *encoded, uint8_t length, struct link_frame *frame)
{
    uint8_t body[MAX_BODY_BYTES];
    uint8_t body_length = uncobs(encoded, length, body);
    if (body_length < HEADER_BYTES + CRC_BYTES) {
        return LINK_DROPPED;
    }
    uint8_t content_length = body_length - CRC_BYTES;
    if (crc_of(body, content_length) != get_u16(body + content_length)) {
        return LINK_DROPPED;
    }
    frame->type = body[0];
    frame->sequence = get_u16(body + 1);
    frame->payload_length = content_length - HEADER_BYTES;
    memcpy(frame->payload, body + HEADER_BYTES, frame->payload_length);
    return LINK_FRAME;
}

enum link_event link_receive(struct link_receiver *receiver, uint8_t byte,
                             struct link_frame *frame)
{
    if (byte != DELIMITER) {
        if (receiver->length < MAX_ENCODED_BYTES) {
            receiver->encoded[receiver->length++] = byte;
        } else {
            link_lose_byte(receiver);
        }
        return LINK_NOTHING;
    }
    uint8_t length = receiver->length;
    receiver->length = 0;
    if (length == 0) {
        return LINK_NOTHING;
    }
    if (length > MAX_ENCODED_BYTES) {
        return LINK_DROPPED;
    }
    return decode(receiver->encoded, length, frame);
}

void link_lose_byte(struct link_receiver *receiver)
{
    receiver->length = MAX_ENCODED_BYTES + 1u;
}

uint8_t link_encode(const struct link_frame *frame, uint8_t bytes[MAX_FRAME_BYTES])
{
    uint8_t body[MAX_BODY_BYTES];
    uint8_t content_length = HEADER_BYTES + frame->payload_length;
    body[0] = frame->type;
    put_u16(body + 1, frame->sequence);
    memcpy(body + HEADER_BYTES, frame->payload, frame->payload_length);
    put_u16(body + content_length, crc_of(body, content_length));

    uint8_t piece_at = 0;
    uint8_t written = 1;
    for (uint8_t i = 0; i < content_length + CRC_BYTES; i++) {
        if (body[i] == 0) {
            bytes[piece_at] = written - piece_at;
            piece_at = written++;
        } else {
            bytes[written++] = body[i];
        }
    }
    bytes[piece_at] = written - piece_at;
    bytes[written++] = DELIMITER;
    return written;
}
