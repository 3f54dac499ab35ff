/* The program of the microcontroller between a computer and a Quanser Qube.
 *
 * The main loop makes all decisions, one after the other, so that no decision sees data that are
 * half written. Interrupts only move bytes and count time, with one exception: the interrupt of the
 * chip's watchdog switches the motor off when no frame to the Qube has ended for 16 ms. */
#include "board.h"
#include "device.h"
#include "link.h"
#include "qube_frame.h"
#include "wire.h"

/* Serial number of the board, most significant byte first: `make SERIAL=0x...`; 0 selects the
 * board's own. */
#ifndef BOARD_SERIAL
#define BOARD_SERIAL 0
#endif

static struct device device;
static struct link_receiver receiver;

static void identify(struct device_identity *identity)
{
    uint64_t serial = BOARD_SERIAL;
    identity->kind = BOARD_KIND;
    if (serial == 0) {
        board_serial(identity->serial);
        return;
    }
    for (uint8_t i = 0; i < sizeof identity->serial; i++) {
        identity->serial[i] = (uint8_t)(serial >> (56 - 8 * i));
    }
}

static void send(const struct link_frame *reply)
{
    uint8_t bytes[MAX_FRAME_BYTES];
    board_send(bytes, link_encode(reply, bytes));
}

/* Passes the Qube's answer to the device if a frame to the Qube has ended. */
static void end_qube_frame(void)
{
    uint8_t answer[QUBE_FRAME_BYTES];
    if (board_qube_ended(answer)) {
        device_frame_ended(&device, answer);
        /* The only place that feeds the hardware watchdog. It is reached only while main loop and
         * SPI work, and while the sampling timer or the host's requests begin frames. Without
         * frames the Qube would keep its last motor word. */
        board_feed_hardware_watchdog();
    }
}

/* Begins a frame to the Qube when the sampling timer demands it, and at once for a new command or
 * a waiting sample. A frame in progress is not interrupted: it ends within 0.2 ms, about the time
 * that the loop takes to read an act and compute its motor word. */
static void begin_qube_frame(void)
{
    if (board_qube_is_busy() || !(board_sampling_is_due() || device_wants_frame(&device))) {
        return;
    }
    struct qube_command command;
    uint8_t bytes[QUBE_FRAME_BYTES];
    device_compose_frame(&device, board_time_us(), &command);
    qube_frame_encode(&command, bytes);
    device_frame_began(&device, board_qube_begin(bytes));
}

/* Takes received bytes up to the end of one request and executes it; returns whether there was one.
 * Requests wait in the ring of received bytes while `device_waits` returns true, and while there is
 * no room for an answer. */
static bool serve_request(void)
{
    struct link_frame frame;
    uint8_t byte;
    bool after_loss;
    while (!device_waits(&device) && board_send_room() >= MAX_FRAME_BYTES) {
        if (!board_receive(&byte, &after_loss)) {
            return false;
        }
        /* Frames that wait in the ring from before the loss are whole. */
        if (after_loss) {
            link_lose_byte(&receiver);
        }
        enum link_event event = link_receive(&receiver, byte, &frame);
        if (event == LINK_DROPPED) {
            device_dropped_frame(&device);
        } else if (event == LINK_FRAME) {
            struct link_frame reply;
            if (device_request(&device, &frame, board_time_us(), &reply)) {
                send(&reply);
            }
            return true;
        }
    }
    return false;
}

int main(void)
{
    struct device_identity identity;
    board_switch_qube_off();
    identify(&identity);
    board_start();
    device_start(&device, &identity, board_next_boot_number, board_stop_switch_is_known());
    for (;;) {
        struct link_frame late_reply;
        do {
            end_qube_frame();
            if (device_answers_late(&device, &late_reply)) {
                send(&late_reply);
            }
            device_poll(&device, board_time_us());
            if (device_stop_switch(&device, board_stop_switch_is_closed(), board_time_us())) {
                board_remember_stop_switch();
            }
            begin_qube_frame();
        } while (serve_request());
        board_sleep();
    }
}
