/* What the device does: states, nonces, watchdog, faults, answers (PROTOCOL.md, sections 3 to 6).
 * Pure C: no registers. Time and bytes are handed in, so a host's compiler can test it. */
#ifndef DEVICE_H
#define DEVICE_H

#include <stdbool.h>
#include <stdint.h>

#include "link.h"
#include "qube_frame.h"

/* Who it is, for the answer to a hello. */
struct device_identity {
    uint8_t kind;
    uint8_t serial[8];
};

/* What is known of one instant: that at which a frame's encoders were read. */
struct device_sample {
    uint32_t time_us;
    int32_t theta_counts;
    int32_t alpha_counts;
    uint32_t tachometer_raw;
    uint16_t current_raw;
    uint8_t status;
    int16_t applied_mv;
    /* The last request whose effect it shows. */
    uint8_t change;
};

struct device {
    struct device_identity identity;
    /* A number that no start of this board has had before. */
    uint16_t (*next_boot_number)(void);
    /* Of this start, and of the nonces: another one when all under it are used up. */
    uint16_t boot_id;
    uint16_t boot_number;
    uint16_t nonces_given;

    enum device_state state;
    /* For the next arm; 0 is none. */
    uint32_t nonce;
    bool watchdog_tripped;
    uint32_t watchdog_fed_us;
    uint16_t last_act_sequence;
    bool awaits_act;
    /* The last sample that was given since the last Hello, which acts must name. */
    bool sample_given;
    uint32_t previous_sample_us;
    uint16_t sample_to_act_us;
    uint16_t dropped_frames;

    /* The emergency-stop switch: whether this board has one, what its contact is and since when, and
     * whether it opened since the last Hello that found it closed. */
    bool stop_switch_fitted;
    bool stop_is_closed;
    uint32_t stop_changed_us;
    bool emergency_stop;

    /* The motor word that should be in force, the one that the frame under way carries, and the one
     * that the Qube got last. */
    uint16_t motor_word;
    uint16_t motor_word_under_way;
    uint16_t motor_word_at_qube;
    /* Counts the requests that change what a sample is to show. */
    uint8_t change;
    /* A stall error is to be cleared by the next frame; this frame clears it. */
    bool clears_stall;
    bool clearing_frame;

    /* Whether a frame has ended since the start: before that nothing is known of the Qube. */
    bool qube_was_asked;
    bool qube_present;
    uint16_t module_id;
    uint8_t qube_status;
    /* Of the frame under way, and of the last one that a Qube answered. */
    struct device_sample begun;
    struct device_sample sample;

    /* A Sample whose frame has not ended yet. */
    bool sample_waits;
    uint16_t waiting_sequence;
};

void device_start(struct device *device, const struct device_identity *identity,
                  uint16_t (*next_boot_number)(void), bool stop_switch_fitted);

/* Carries a request out. Returns whether `reply` is to be sent now. None may be handed in while
 * `device_waits`: a sample waits for its frame and is answered by `device_answers_late`, or nothing
 * is known of the Qube yet. */
bool device_request(struct device *device, const struct link_frame *request, uint32_t now_us,
                    struct link_frame *reply);
bool device_waits(const struct device *device);
bool device_answers_late(struct device *device, struct link_frame *reply);

/* Bytes came that are no frame. */
void device_dropped_frame(struct device *device);

/* The watchdog. To be called at least every WATCHDOG_POLL_MS. */
void device_poll(struct device *device, uint32_t now_us);

/* What the contact of the emergency-stop switch is now: low is closed, and open is what a broken wire
 * or a missing switch looks like too. To be called at least every WATCHDOG_POLL_MS. Returns true once:
 * when the contact has been closed for so long that there must be a switch, which the board then
 * remembers over power-off. */
bool device_stop_switch(struct device *device, bool is_closed, uint32_t now_us);

/* Whether a frame should begin now, without waiting for the sampling timer. */
bool device_wants_frame(const struct device *device);
/* What the frame that begins now is to say; `device_frame_began` tells when its encoders were
 * read. */
void device_compose_frame(struct device *device, uint32_t now_us, struct qube_command *command);
void device_frame_began(struct device *device, uint32_t time_us);
/* It has ended. */
void device_frame_ended(struct device *device, const uint8_t answer[QUBE_FRAME_BYTES]);

#endif
