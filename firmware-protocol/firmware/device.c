#include "device.h"

#include <string.h>

#define WATCHDOG_US (WATCHDOG_MS * 1000ul)

/* Time for which a contact must be open to count as open, us: a shorter opening is a spike. */
#define STOP_OPEN_US 3000ul
/* Time for which a contact must be closed to belong to a switch, us. */
#define STOP_FITTED_US 100000ul

/* Frames in a row without a Qube after which it counts as switched off. */
#define ABSENT_FRAMES_OF_OFF 2u

/* Bit of the clock that makes red blink at 2 Hz: it changes every 262 ms. */
#define BLINK_BIT_US (1ul << 18)

/* Brightness of the LED: visible in daylight, and not dazzling. */
#define LED_ON (QUBE_LED_MAX / 2u)

static bool is_newer(uint16_t candidate, uint16_t last)
{
    return (int16_t)(uint16_t)(candidate - last) > 0;
}

/* Returns whether an act may answer this sample: it is the last one given and no older than
 * 20 ms. */
static bool answers_fresh_sample(const struct device *device, uint32_t sampled_at_us, uint32_t now_us)
{
    return device->sample_given && sampled_at_us == device->previous_sample_us &&
           now_us - sampled_at_us <= MAX_SAMPLE_AGE_US;
}

static void give_nonce(struct device *device)
{
    if (++device->nonces_given == 0) {
        /* All numbers under this boot number are used up, so a new one is needed. */
        device->boot_number = device->next_boot_number();
        device->nonces_given = 1;
    }
    device->nonce = ((uint32_t)device->boot_number << 16) | device->nonces_given;
}

/* Switches the motor off and enters the state `next`. */
static void leave_armed(struct device *device, enum device_state next)
{
    device->motor_word = MOTOR_OFF;
    device->clears_stall = false;
    device->state = next;
}

void device_start(struct device *device, const struct device_identity *identity,
                  uint16_t (*next_boot_number)(void), bool stop_switch_fitted)
{
    memset(device, 0, sizeof *device);
    device->identity = *identity;
    device->next_boot_number = next_boot_number;
    device->boot_number = next_boot_number();
    device->boot_id = device->boot_number;
    device->stop_switch_fitted = stop_switch_fitted;
    device->state = STATE_IDLE;
    device->motor_word = MOTOR_OFF;
    /* The Qube's motor word from before this start is unknown. With a word other than off, the
     * first frame begins at once. */
    device->motor_word_at_qube = MOTOR_ENABLE;
    device->sample_to_act_us = NO_ACT_US;
}

/* --- answers --- */

static void begin_reply(struct link_frame *reply, uint8_t type, uint8_t payload_length)
{
    reply->type = type;
    reply->payload_length = payload_length;
}

static bool refuse(struct link_frame *reply, uint8_t refused_type, uint8_t reason)
{
    begin_reply(reply, REPLY_REFUSAL, 2);
    reply->payload[0] = refused_type;
    reply->payload[1] = reason;
    return true;
}

static bool hello(struct device *device, uint16_t host_version, struct link_frame *reply)
{
    bool understood = host_version == PROTOCOL_VERSION;
    leave_armed(device, understood ? STATE_GREETED : STATE_IDLE);
    device->change++;
    device->nonce = 0;
    device->amplifier_failed = false;
    if (understood) {
        give_nonce(device);
    }
    device->awaits_act = false;
    device->sample_given = false;
    device->sample_to_act_us = NO_ACT_US;
    device->last_act_sequence = 0;
    if (understood && device->stop_is_closed) {
        device->emergency_stop = false;
    }

    begin_reply(reply, REPLY_HELLO, 24);
    uint8_t *payload = reply->payload;
    put_u16(payload, PROTOCOL_VERSION);
    payload[2] = FIRMWARE_VERSION_MAJOR;
    payload[3] = FIRMWARE_VERSION_MINOR;
    payload[4] = FIRMWARE_VERSION_PATCH;
    payload[5] = device->identity.kind;
    put_u16(payload + 6, device->module_id);
    memcpy(payload + 8, device->identity.serial, 8);
    put_u32(payload + 16, device->nonce);
    put_u16(payload + 20, device->boot_id);
    put_u16(payload + 22, device->dropped_frames);
    return true;
}

/* The reason why this state refuses the request, an Arm or an Act; 0 if it does not. */
static uint8_t state_refuses(const struct device *device, uint8_t request)
{
    switch (device->state) {
    case STATE_IDLE:
        return REFUSAL_NOT_GREETED;
    case STATE_GREETED:
        return request == REQUEST_ACT ? REFUSAL_NOT_ARMED : 0;
    case STATE_ARMED:
        return request == REQUEST_ARM ? REFUSAL_ALREADY_ARMED : 0;
    case STATE_TRIPPED:
        return REFUSAL_WATCHDOG_TRIPPED;
    case STATE_FAULTED:
        break;
    }
    return REFUSAL_FAULTED;
}

static uint8_t arm_refused(const struct device *device, uint32_t nonce)
{
    uint8_t reason = state_refuses(device, REQUEST_ARM);
    if (reason != 0) {
        return reason;
    }
    if (nonce == 0 || nonce != device->nonce) {
        return REFUSAL_WRONG_NONCE;
    }
    if (!device->qube_present) {
        return REFUSAL_QUBE_ABSENT;
    }
    if (device->emergency_stop) {
        return REFUSAL_EMERGENCY_STOP;
    }
    return device->qube_status & QUBE_AMPLIFIER_FAULT ? REFUSAL_FAULTED : 0;
}

static bool arm(struct device *device, const struct link_frame *request, uint32_t now_us,
                struct link_frame *reply)
{
    uint8_t reason = arm_refused(device, get_u32(request->payload));
    if (reason != 0) {
        return refuse(reply, REQUEST_ARM, reason);
    }
    device->nonce = 0;
    device->watchdog_tripped = false;
    device->watchdog_fed_us = now_us;
    device->last_act_sequence = request->sequence;
    device->clears_stall = device->qube_status & QUBE_STALL_ERROR;
    device->motor_word = motor_word(0);
    device->state = STATE_ARMED;
    device->change++;
    begin_reply(reply, REPLY_ARM, 4);
    put_u32(reply->payload, now_us);
    return true;
}

static bool act(struct device *device, const struct link_frame *request, uint32_t now_us,
                struct link_frame *reply)
{
    int16_t voltage_mv = (int16_t)get_u16(request->payload);
    uint8_t reason = state_refuses(device, REQUEST_ACT);
    if (reason == 0 && !is_newer(request->sequence, device->last_act_sequence)) {
        reason = REFUSAL_STALE_SEQUENCE;
    }
    if (reason == 0 && (voltage_mv > MAX_VOLTAGE_MV || voltage_mv < -MAX_VOLTAGE_MV)) {
        reason = REFUSAL_VOLTAGE_OUT_OF_RANGE;
    }
    if (reason == 0 && !answers_fresh_sample(device, get_u32(request->payload + 2), now_us)) {
        reason = REFUSAL_STALE_SAMPLE;
    }
    if (reason != 0) {
        return refuse(reply, REQUEST_ACT, reason);
    }
    device->last_act_sequence = request->sequence;
    device->watchdog_fed_us = now_us;
    if (device->awaits_act) {
        device->awaits_act = false;
        uint32_t elapsed_us = now_us - device->previous_sample_us;
        device->sample_to_act_us = elapsed_us < NO_ACT_US ? (uint16_t)elapsed_us : NO_ACT_US - 1u;
    }
    device->motor_word = motor_word(motor_counts(voltage_mv));
    device->change++;
    return false;
}

static bool disarm(struct device *device, struct link_frame *reply)
{
    if (device->state == STATE_ARMED) {
        leave_armed(device, STATE_GREETED);
        device->change++;
        give_nonce(device);
    }
    begin_reply(reply, REPLY_DISARM, 7);
    reply->payload[0] = device->state;
    put_u32(reply->payload + 1, device->nonce);
    put_u16(reply->payload + 5, device->dropped_frames);
    return true;
}

static bool answer_sample(struct device *device, struct link_frame *reply)
{
    if (!device->qube_present) {
        return refuse(reply, REQUEST_SAMPLE, REFUSAL_QUBE_ABSENT);
    }
    /* The Qube may have come back while the Sample waited. */
    if (device->state == STATE_IDLE) {
        return refuse(reply, REQUEST_SAMPLE, REFUSAL_NOT_GREETED);
    }
    const struct device_sample *sample = &device->sample;
    begin_reply(reply, REPLY_SAMPLE, 25);
    uint8_t *payload = reply->payload;
    put_u32(payload, sample->time_us);
    put_u32(payload + 4, (uint32_t)sample->theta_counts);
    put_u32(payload + 8, (uint32_t)sample->alpha_counts);
    put_u32(payload + 12, (uint32_t)tachometer_counts_s(sample->tachometer_raw));
    put_u16(payload + 16, (uint16_t)current_ma(sample->current_raw));
    payload[18] = sample->status;
    put_u16(payload + 19, (uint16_t)sample->applied_mv);
    put_u16(payload + 21, device->last_act_sequence);
    put_u16(payload + 23, device->sample_to_act_us);
    device->previous_sample_us = sample->time_us;
    device->sample_given = true;
    device->awaits_act = true;
    device->sample_to_act_us = NO_ACT_US;
    return true;
}

/* Returns whether a Sample can be answered: the last reading shows the effect of all requests, or
 * there is no Qube whose reading it could wait for. After a single odd frame the Sample waits for
 * the next one. */
static bool sample_is_ready(const struct device *device)
{
    if (!device->qube_present) {
        return device->absent_frames >= ABSENT_FRAMES_OF_OFF;
    }
    return device->sample.change == device->change;
}

static bool sample(struct device *device, const struct link_frame *request,
                   struct link_frame *reply)
{
    if (device->state == STATE_IDLE) {
        return refuse(reply, REQUEST_SAMPLE, REFUSAL_NOT_GREETED);
    }
    /* The sampling timer's last reading is up to a period, 2 ms, old, and every act would be as
     * late. A separate reading takes a tenth of that. */
    device->change++;
    if (!sample_is_ready(device)) {
        device->sample_waits = true;
        device->waiting_sequence = request->sequence;
        return false;
    }
    return answer_sample(device, reply);
}

bool device_waits(const struct device *device)
{
    return device->sample_waits || !device->qube_was_asked;
}

bool device_answers_late(struct device *device, struct link_frame *reply)
{
    if (!device->sample_waits || !sample_is_ready(device)) {
        return false;
    }
    device->sample_waits = false;
    reply->sequence = device->waiting_sequence;
    return answer_sample(device, reply);
}

/* Length of a request's payload; -1 for a type that is not a request. */
static int8_t payload_length_of(uint8_t type)
{
    switch (type) {
    case REQUEST_HELLO:
        return 2;
    case REQUEST_ACT:
        return 6;
    case REQUEST_ARM:
        return 4;
    case REQUEST_SAMPLE:
    case REQUEST_DISARM:
        return 0;
    default:
        return -1;
    }
}

bool device_request(struct device *device, const struct link_frame *request, uint32_t now_us,
                    struct link_frame *reply)
{
    if (request->type >= FIRST_REPLY_TYPE) {
        /* Another device, or an echo: an answer could start an endless exchange. */
        device_dropped_frame(device);
        return false;
    }
    reply->sequence = request->sequence;
    int8_t payload_length = payload_length_of(request->type);
    if (payload_length < 0) {
        return refuse(reply, request->type, REFUSAL_UNKNOWN_TYPE);
    }
    if (request->payload_length != payload_length) {
        return refuse(reply, request->type, REFUSAL_WRONG_LENGTH);
    }
    switch (request->type) {
    case REQUEST_HELLO:
        return hello(device, get_u16(request->payload), reply);
    case REQUEST_ARM:
        return arm(device, request, now_us, reply);
    case REQUEST_SAMPLE:
        return sample(device, request, reply);
    case REQUEST_ACT:
        return act(device, request, now_us, reply);
    default:
        return disarm(device, reply);
    }
}

void device_dropped_frame(struct device *device)
{
    device->dropped_frames++;
}

/* --- time --- */

void device_poll(struct device *device, uint32_t now_us)
{
    if (device->state == STATE_ARMED && now_us - device->watchdog_fed_us >= WATCHDOG_US) {
        device->watchdog_tripped = true;
        leave_armed(device, STATE_TRIPPED);
    }
}

/* --- the emergency stop --- */

bool device_stop_switch(struct device *device, bool is_closed, uint32_t now_us)
{
    if (is_closed != device->stop_is_closed) {
        device->stop_is_closed = is_closed;
        device->stop_changed_us = now_us;
    }
    uint32_t unchanged_us = now_us - device->stop_changed_us;
    if (!device->stop_switch_fitted) {
        device->stop_switch_fitted = is_closed && unchanged_us >= STOP_FITTED_US;
        return device->stop_switch_fitted;
    }
    if (!is_closed && !device->emergency_stop && unchanged_us >= STOP_OPEN_US) {
        device->emergency_stop = true;
        if (device->state == STATE_ARMED) {
            leave_armed(device, STATE_FAULTED);
        }
    }
    return false;
}

/* --- the Qube --- */

bool device_wants_frame(const struct device *device)
{
    return device->motor_word != device->motor_word_at_qube || device->clears_stall ||
           device->sample_waits;
}

static void light(const struct device *device, uint32_t now_us, struct qube_command *command)
{
    command->red = 0;
    command->green = 0;
    command->blue = 0;
    if (device->emergency_stop) {
        command->red = LED_ON;
        command->blue = LED_ON;
        return;
    }
    switch (device->state) {
    case STATE_IDLE:
        command->red = LED_ON / 4u;
        command->green = LED_ON / 4u;
        command->blue = LED_ON / 4u;
        break;
    case STATE_GREETED:
        command->blue = LED_ON;
        break;
    case STATE_ARMED:
        command->green = LED_ON;
        break;
    case STATE_TRIPPED:
        command->red = LED_ON;
        break;
    case STATE_FAULTED:
        command->red = now_us & BLINK_BIT_US ? LED_ON : 0;
        break;
    }
}

void device_compose_frame(struct device *device, uint32_t now_us, struct qube_command *command)
{
    device->clearing_frame = device->clears_stall;
    device->clears_stall = false;
    command->write_mask =
        device->clearing_frame ? QUBE_WRITE_ALL_AND_PRESETS : QUBE_WRITE_ALL;
    command->motor_word = device->clearing_frame ? MOTOR_OFF : device->motor_word;
    device->motor_word_under_way = command->motor_word;
    light(device, now_us, command);

    /* The encoders of a frame are read while the commands of earlier frames are in force. */
    struct device_sample *begun = &device->begun;
    bool is_on = device->motor_word_at_qube & MOTOR_ENABLE;
    begun->applied_mv = motor_word_mv(device->motor_word_at_qube);
    begun->status = 0;
    if (is_on) {
        begun->status |= STATUS_ARMED;
    } else if (device->watchdog_tripped) {
        begun->status |= STATUS_WATCHDOG_TRIPPED;
    }
    if (device->emergency_stop) {
        begun->status |= STATUS_EMERGENCY_STOP;
    }
    if (device->stop_switch_fitted) {
        begun->status |= STATUS_STOP_SWITCH_FITTED;
    }
    if (device->motor_word == device->motor_word_at_qube && !device->clearing_frame) {
        begun->change = device->change;
    }
}

void device_frame_began(struct device *device, uint32_t time_us)
{
    device->begun.time_us = time_us;
}

static void take_readings(struct device *device, const struct qube_readings *readings)
{
    struct device_sample *begun = &device->begun;
    begun->theta_counts = extend_counts(begun->theta_counts, readings->theta_raw);
    begun->alpha_counts = extend_counts(begun->alpha_counts, readings->alpha_raw);
    begun->tachometer_raw = readings->tachometer_raw;
    begun->current_raw = readings->current_raw;
    /* A fault may be over before the host's next Sample, which must still name it. */
    if ((readings->status & QUBE_AMPLIFIER_FAULT) || device->amplifier_failed) {
        begun->status |= STATUS_AMPLIFIER_FAULT;
    }
    if (readings->status & QUBE_STALL_DETECTED) {
        begun->status |= STATUS_STALL_DETECTED;
    }
    if (readings->status & QUBE_STALL_ERROR) {
        begun->status |= STATUS_STALL_ERROR;
    }
    device->sample = *begun;
}

/* Counts the frames without a Qube. A Qube that comes back was off, so its counters have begun
 * anew: the host must greet again. A single odd frame may be noise on the wires. */
static void follow_presence(struct device *device)
{
    if (device->qube_present) {
        if (device->absent_frames >= ABSENT_FRAMES_OF_OFF) {
            leave_armed(device, STATE_IDLE);
            device->nonce = 0;
        }
        device->absent_frames = 0;
    } else if (device->absent_frames < ABSENT_FRAMES_OF_OFF) {
        device->absent_frames++;
    }
}

void device_frame_ended(struct device *device, const uint8_t answer[QUBE_FRAME_BYTES])
{
    struct qube_readings readings;
    qube_frame_decode(answer, &readings);
    device->motor_word_at_qube = device->motor_word_under_way;
    device->qube_was_asked = true;
    device->module_id = readings.module_id;
    device->qube_present = readings.module_id == QUBE_MODULE_ID;
    device->qube_status = readings.status;
    follow_presence(device);

    bool failed = !device->qube_present;
    if (device->qube_present) {
        take_readings(device, &readings);
        /* A stall error that this frame or the next one clears does not lead to Faulted. */
        bool stall_is_known = device->clears_stall || device->clearing_frame;
        failed = (readings.status & QUBE_AMPLIFIER_FAULT) ||
                 ((readings.status & QUBE_STALL_ERROR) && !stall_is_known);
    }
    device->clearing_frame = false;
    if (failed && device->state == STATE_ARMED) {
        device->amplifier_failed =
            device->qube_present && (readings.status & QUBE_AMPLIFIER_FAULT);
        leave_armed(device, STATE_FAULTED);
    }
}
