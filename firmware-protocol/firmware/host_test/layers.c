/* Answers questions about the firmware's pure layers, compiled for the computer: one question a
 * line of standard input, one answer a line of output. The test
 * firmware-protocol/tests/firmware_layers.rs asks. Times are in microseconds.
 *
 *   stream HEX              the frames and the dropped frames in these bytes
 *   again HEX               a frame decoded and encoded again
 *   motor MILLIVOLT         counts, motor word, applied millivolt
 *   current RAW             milliampere
 *   tachometer RAW          counts per second
 *   extend LAST RAW         the counter in 32 bits
 *   newer CANDIDATE LAST    1 if an act numbered CANDIDATE is accepted after an Arm numbered LAST,
 *                           else 0
 *   watchdog FED NOW        the state and the motor word at NOW of a device armed at FED
 *   fresh SAMPLED GIVEN NOW 1 if an act at NOW that names the sample of SAMPLED is accepted when
 *                           the last sample given is that of GIVEN (or none), else 0
 *   stop FITTED EVENTS      the state after each event, with ! while the emergency stop is latched
 *                           and ? while no switch is known; r where the stop refuses an Arm.
 *                           EVENTS: c or o a millisecond of closed or open contact, h a Hello,
 *                           a an Arm
 */
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "../device.h"
#include "../link.h"
#include "../qube_frame.h"

static void feed_hex(const char *hex, bool again)
{
    struct link_receiver receiver = {0};
    struct link_frame frame;
    for (size_t at = 0; hex[at] && hex[at + 1]; at += 2) {
        unsigned byte = 0;
        sscanf(hex + at, "%2x", &byte);
        switch (link_receive(&receiver, (uint8_t)byte, &frame)) {
        case LINK_NOTHING:
            break;
        case LINK_DROPPED:
            printf(" dropped");
            break;
        case LINK_FRAME:
            if (again) {
                uint8_t bytes[MAX_FRAME_BYTES];
                uint8_t length = link_encode(&frame, bytes);
                printf(" ");
                for (uint8_t i = 0; i < length; i++) {
                    printf("%02x", bytes[i]);
                }
            } else {
                printf(" %02x:%04x:", frame.type, frame.sequence);
                for (uint8_t i = 0; i < frame.payload_length; i++) {
                    printf("%02x", frame.payload[i]);
                }
            }
        }
    }
}

static uint16_t first_boot(void)
{
    return 1;
}

static bool act(struct device *device, uint16_t sequence, uint32_t sampled_at_us, uint32_t now_us,
                struct link_frame *reply)
{
    struct link_frame request = {.type = REQUEST_ACT, .sequence = sequence, .payload_length = 6};
    put_u32(request.payload + 2, sampled_at_us);
    return device_request(device, &request, now_us, reply);
}

static bool ask(struct device *device, uint8_t type, uint16_t sequence, uint32_t value,
                uint8_t payload_length, uint32_t now_us, struct link_frame *reply)
{
    struct link_frame request = {.type = type, .sequence = sequence};
    request.payload_length = payload_length;
    put_u32(request.payload, value);
    return device_request(device, &request, now_us, reply);
}

/* Starts a device with a Qube and greets it by a Hello numbered one below `sequence`. */
static void greet(struct device *device, uint16_t sequence, uint32_t now_us, bool stop_switch_fitted)
{
    static const struct device_identity IDENTITY = {.kind = KIND_ATMEGA328P};
    static const uint8_t ANSWER[QUBE_FRAME_BYTES] = {QUBE_MODULE_ID >> 8, QUBE_MODULE_ID & 0xFF};
    struct qube_command command;
    struct link_frame reply;
    device_start(device, &IDENTITY, first_boot, stop_switch_fitted);
    device_compose_frame(device, now_us, &command);
    device_frame_began(device, now_us);
    device_frame_ended(device, ANSWER);
    ask(device, REQUEST_HELLO, sequence - 1, PROTOCOL_VERSION, 2, now_us, &reply);
}

/* Starts and greets a device with a Qube, and arms it by a request with this sequence number. */
static void arm(struct device *device, uint16_t sequence, uint32_t now_us)
{
    struct link_frame reply;
    greet(device, sequence, now_us, false);
    ask(device, REQUEST_ARM, sequence, device->nonce, 4, now_us, &reply);
    if (device->state != STATE_ARMED) {
        printf(" the device does not arm");
    }
}

static void stop_switch(bool fitted, const char *events)
{
    struct device device;
    struct link_frame reply;
    uint32_t now_us = 0;
    greet(&device, 1, now_us, fitted);
    for (; *events; events++) {
        switch (*events) {
        case 'c':
        case 'o':
            for (int i = 0; i < 4; i++) {
                now_us += 250;
                device_stop_switch(&device, *events == 'c', now_us);
            }
            break;
        case 'h':
            ask(&device, REQUEST_HELLO, 9, PROTOCOL_VERSION, 2, now_us, &reply);
            break;
        default:
            ask(&device, REQUEST_ARM, 10, device.nonce, 4, now_us, &reply);
            if (reply.type == REPLY_REFUSAL && reply.payload[1] == REFUSAL_EMERGENCY_STOP) {
                printf(" r");
                continue;
            }
        }
        printf(" %d%s%s", device.state, device.emergency_stop ? "!" : "",
               device.stop_switch_fitted ? "" : "?");
    }
}

static void answer(const char *kind, const char *first, const char *second, const char *third)
{
    struct device device;
    struct link_frame reply;
    long long first_number = strtoll(first, NULL, 0);
    long long second_number = second ? strtoll(second, NULL, 0) : 0;
    if (!strcmp(kind, "stream") || !strcmp(kind, "again")) {
        feed_hex(first, kind[0] == 'a');
    } else if (!strcmp(kind, "motor")) {
        uint16_t word = motor_word(motor_counts((int16_t)first_number));
        printf(" %d 0x%04x %d", motor_counts((int16_t)first_number), word, motor_word_mv(word));
    } else if (!strcmp(kind, "current")) {
        printf(" %d", current_ma((uint16_t)first_number));
    } else if (!strcmp(kind, "tachometer")) {
        printf(" %" PRId32, tachometer_counts_s((uint32_t)first_number));
    } else if (!strcmp(kind, "extend")) {
        printf(" %" PRId32, extend_counts((int32_t)first_number, (uint32_t)second_number));
    } else if (!strcmp(kind, "newer")) {
        arm(&device, (uint16_t)second_number, 0);
        device.sample_given = true;
        device.previous_sample_us = 0;
        printf(" %d", !act(&device, (uint16_t)first_number, 0, 0, &reply));
    } else if (!strcmp(kind, "watchdog")) {
        arm(&device, 1, (uint32_t)first_number);
        device_poll(&device, (uint32_t)second_number);
        printf(" %d 0x%04x", device.state, device.motor_word);
    } else if (!strcmp(kind, "fresh")) {
        uint32_t now_us = third ? (uint32_t)strtoll(third, NULL, 0) : 0;
        arm(&device, 1, now_us);
        device.sample_given = strcmp(second, "none") != 0;
        device.previous_sample_us = (uint32_t)second_number;
        printf(" %d", !act(&device, 2, (uint32_t)first_number, now_us, &reply));
    } else if (!strcmp(kind, "stop")) {
        stop_switch(first_number, second);
    } else {
        printf(" unknown question");
    }
}

int main(void)
{
    char line[4096];
    while (fgets(line, sizeof line, stdin)) {
        char *kind = strtok(line, " \n");
        char *first = strtok(NULL, " \n");
        char *second = strtok(NULL, " \n");
        char *third = strtok(NULL, " \n");
        if (kind && first) {
            printf("%s", kind);
            answer(kind, first, second, third);
            printf("\n");
        }
    }
    return 0;
}
