/* The device's behaviour: states, nonces, watchdog, faults, answers (PROTOCOL.md, sections 3 to
 * 6). Pure C without registers: time and bytes are arguments, so that a host's compiler can test
 * it. */
#ifndef DEVICE_H
#define DEVICE_H

#include <stdbool.h>
#include <stdint.h>

#include "link.h"
#include "qube_frame.h"

/* Identity of the board, for the answer to a hello. */
struct device_identity {
    uint8_t kind;
    uint8_t serial[8];
};

/* Readings of one instant, at which a frame's encoders were read. */
struct device_sample {
    uint32_t time_us;
    int32_t theta_counts;
    int32_t alpha_counts;
    uint32_t tachometer_raw;
    uint16_t current_raw;
    uint8_t status;
    int16_t applied_mv;
    /* Number, modulo 256, of the last request whose effect the readings show. */
    uint8_t change;
};

struct device {
    struct device_identity identity;
    /* Returns a number that none of the last 65 535 calls on this board has returned. */
    uint16_t (*next_boot_number)(void);
    /* Number of this start, and the upper half of its nonces. The two are equal until all 65 535
     * nonces under `boot_number` are used up; `boot_number` is then replaced. */
    uint16_t boot_id;
    uint16_t boot_number;
    uint16_t nonces_given;

    enum device_state state;
    /* Nonce for the next arm; 0 is none. */
    uint32_t nonce;
    bool watchdog_tripped;
    /* True if an amplifier fault has led to Faulted since the last Hello. */
    bool amplifier_failed;
    uint32_t watchdog_fed_us;
    uint16_t last_act_sequence;
    /* True if a sample was given that no act has answered yet. */
    bool awaits_act;
    /* Last sample given since the last Hello, which acts must name. */
    bool sample_given;
    uint32_t previous_sample_us;
    uint16_t sample_to_act_us;
    uint16_t dropped_frames;

    /* Emergency-stop switch: whether the board has one, the state of its contact and since when,
     * and whether it has opened since the last Hello that found it closed. */
    bool stop_switch_fitted;
    bool stop_is_closed;
    uint32_t stop_changed_us;
    bool emergency_stop;

    /* Motor words: the one that should be in force, the one in the current frame, and the last
     * one that the Qube received. */
    uint16_t motor_word;
    uint16_t motor_word_under_way;
    uint16_t motor_word_at_qube;
    /* Number, modulo 256, of the last request whose effect a sample must show. A Sample is such a
     * request, too: it demands a reading of its own. */
    uint8_t change;
    /* True if the next frame must clear a stall error; true if the current frame does. */
    bool clears_stall;
    bool clearing_frame;

    /* True once a frame has ended since the start; until then nothing is known of the Qube. */
    bool qube_was_asked;
    bool qube_present;
    uint8_t absent_frames;
    uint16_t module_id;
    uint8_t qube_status;
    /* Readings of the current frame, and of the last one that a Qube answered. */
    struct device_sample begun;
    struct device_sample sample;

    /* A Sample whose frame has not ended yet. */
    bool sample_waits;
    uint16_t waiting_sequence;
};

void device_start(struct device *device, const struct device_identity *identity,
                  uint16_t (*next_boot_number)(void), bool stop_switch_fitted);

/* Executes a request; returns whether `reply` must be sent now. Must not be called while
 * `device_waits` returns true. */
bool device_request(struct device *device, const struct link_frame *request, uint32_t now_us,
                    struct link_frame *reply);
/* Returns whether requests must wait: for the frame of a Sample, or for the end of the first frame,
 * before which nothing is known of the Qube. */
bool device_waits(const struct device *device);
/* Answers a Sample whose frame has ended; returns whether `reply` must be sent now. */
bool device_answers_late(struct device *device, struct link_frame *reply);

/* Counts bytes that were not a frame. */
void device_dropped_frame(struct device *device);

/* Runs the watchdog; must be called at least every WATCHDOG_POLL_MS. */
void device_poll(struct device *device, uint32_t now_us);

/* Takes the state of the emergency-stop contact; a broken wire or a missing switch counts as
 * open. Must be called at least every WATCHDOG_POLL_MS. Returns true once, when the contact
 * has been closed for so long that there must be a switch, which the board then stores. */
bool device_stop_switch(struct device *device, bool is_closed, uint32_t now_us);

/* Returns whether a frame should begin now, without waiting for the sampling timer. */
bool device_wants_frame(const struct device *device);
/* Composes the content of the frame that begins now; `device_frame_began` then takes the time at
 * which its encoders were read. */
void device_compose_frame(struct device *device, uint32_t now_us, struct qube_command *command);
void device_frame_began(struct device *device, uint32_t time_us);
/* Takes the Qube's answer at the end of the frame. */
void device_frame_ended(struct device *device, const uint8_t answer[QUBE_FRAME_BYTES]);

#endif
