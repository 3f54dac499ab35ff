/* Measures how fast a control program and a board can at best exchange frames over a pty: 100 times a second
   the host asks for a sample, the board answers, and the host sends its act. The board measures the time from
   sample to act. Frames have the lengths of PROTOCOL.md and no content. Prints percentiles of this time in
   microseconds as one JSON object.

   usage: echo-over-pty SECONDS [PRIORITY [REQUEST REPLY ACT]]
   PRIORITY is the priority under SCHED_FIFO, or 0 for no real time [40]; REQUEST, REPLY and ACT are the lengths of the
   frames in bytes [7 32 13]. */
#define _GNU_SOURCE
#include <fcntl.h>
#include <pthread.h>
#include <sched.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

enum { PERIOD_NS = 10000000, LONGEST = 64 };

static int host_end, board_end, turns, priority;
static int request_bytes = 7, reply_bytes = 32, act_bytes = 13;
static int64_t *sample_to_act_ns;

static int64_t now_ns(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * 1000000000LL + now.tv_nsec;
}

static void give_up(const char *operation) {
    perror(operation);
    exit(1);
}

static void receive(int end, int length) {
    char bytes[LONGEST];
    for (int got = 0; got < length;) {
        ssize_t more = read(end, bytes, length - got);
        if (more <= 0) give_up("read");
        got += more;
    }
}

static void send_frame(int end, int length) {
    static const char bytes[LONGEST];
    if (write(end, bytes, length) != length) give_up("write");
}

static void enter_realtime(void) {
    struct sched_param wanted = {.sched_priority = priority};
    if (priority > 0 && pthread_setschedparam(pthread_self(), SCHED_FIFO, &wanted))
        give_up("SCHED_FIFO");
}

static void *board(void *unused) {
    enter_realtime();
    for (int turn = 0; turn < turns; turn++) {
        receive(board_end, request_bytes);
        int64_t sampled_ns = now_ns();
        send_frame(board_end, reply_bytes);
        receive(board_end, act_bytes);
        sample_to_act_ns[turn] = now_ns() - sampled_ns;
    }
    return unused;
}

static int by_size(const void *left, const void *right) {
    int64_t a = *(const int64_t *)left, b = *(const int64_t *)right;
    return (a > b) - (a < b);
}

static double percentile_us(double share) {
    int rank = (int)(share * turns + 0.999999);
    return sample_to_act_ns[rank < 1 ? 0 : rank - 1] / 1000.0;
}

int main(int count, char **arguments) {
    if (count < 2) return 2;
    turns = atoi(arguments[1]) * 100;
    priority = count > 2 ? atoi(arguments[2]) : 40;
    if (count > 5) {
        request_bytes = atoi(arguments[3]);
        reply_bytes = atoi(arguments[4]);
        act_bytes = atoi(arguments[5]);
    }
    if (turns < 1 || request_bytes > LONGEST || reply_bytes > LONGEST || act_bytes > LONGEST) return 2;
    sample_to_act_ns = calloc(turns, sizeof *sample_to_act_ns);
    mlockall(MCL_CURRENT | MCL_FUTURE);
    /* No processor goes to sleep while this file is open; cyclictest does the same by default. */
    int32_t awake = 0;
    int latency = open("/dev/cpu_dma_latency", O_WRONLY);
    if (latency >= 0 && write(latency, &awake, sizeof awake) < 0) perror("cpu_dma_latency");

    board_end = posix_openpt(O_RDWR | O_NOCTTY);
    if (board_end < 0 || grantpt(board_end) || unlockpt(board_end)) give_up("pty");
    host_end = open(ptsname(board_end), O_RDWR | O_NOCTTY);
    struct termios raw;
    if (host_end < 0 || tcgetattr(host_end, &raw)) give_up("pty");
    cfmakeraw(&raw);
    raw.c_cc[VMIN] = 1;
    raw.c_cc[VTIME] = 0;
    if (tcsetattr(host_end, TCSANOW, &raw)) give_up("pty");

    pthread_t server;
    if (pthread_create(&server, NULL, board, NULL)) give_up("thread");
    enter_realtime();
    struct timespec deadline;
    clock_gettime(CLOCK_MONOTONIC, &deadline);
    for (int turn = 0; turn < turns; turn++) {
        deadline.tv_nsec += PERIOD_NS;
        if (deadline.tv_nsec >= 1000000000) {
            deadline.tv_nsec -= 1000000000;
            deadline.tv_sec++;
        }
        clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &deadline, NULL);
        send_frame(host_end, request_bytes);
        receive(host_end, reply_bytes);
        send_frame(host_end, act_bytes);
    }
    pthread_join(server, NULL);
    qsort(sample_to_act_ns, turns, sizeof *sample_to_act_ns, by_size);
    printf("{\"p50\":%.1f,\"p99\":%.1f,\"p999\":%.1f,\"max\":%.1f}\n", percentile_us(0.5),
           percentile_us(0.99), percentile_us(0.999), percentile_us(1));
}
