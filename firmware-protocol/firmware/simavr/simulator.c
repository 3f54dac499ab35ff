/* Runs the firmware's ELF in simavr, paced to real time: UART 0 on a pty, SPI handed to the process
 * that started this one. For tests only.
 *
 * Copyright (C) the qube-hil authors. SPDX-License-Identifier: GPL-3.0-or-later
 * This file alone is under the GPL, because it is linked with libsimavr; see README.md beside it.
 *
 *   simulator ELF atmega328p|atmega2560 MEMORY_SEED
 *
 * MEMORY_SEED determines the content of the memory at power-on.
 * Prints the pty's path on its first line of output. Then it writes, in binary, one `struct event`
 * when chip select falls, which must be answered on standard input by one `struct answer` before
 * time goes on, and one when it rises. Ends when standard input does. */
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <pty.h>
#include <sched.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#include <simavr/avr_ioport.h>
#include <simavr/avr_spi.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>

#define FREQUENCY_HZ 16000000u
#define CYCLES_PER_US 16u
#define BAUD_RATE 500000u
/* A byte has ten bits: start bit, eight data bits, stop bit. simavr itself adds a parity bit that
 * does not exist. */
#define CYCLES_PER_BYTE (10u * FREQUENCY_HZ / BAUD_RATE)
/* A receiver holds two unread bytes; the third is lost. simavr would hold 64. */
#define UART_HOLDS_BYTES 2u

#define FRAME_BYTES 17u

/* Longest step of the simulation before the program looks at the pty again. */
#define SLICE_US 100u
/* Longest delay that the simulation makes up for. The excess of a longer one is skipped: otherwise
 * the program would see a silent host only because this process was not scheduled. */
#define MAX_BEHIND_US 4000u
#define HOUSEKEEPING_US 100000u

enum event_kind { CHIP_SELECT_FALLS = 'L', CHIP_SELECT_RISES = 'H' };

struct event {
    uint8_t kind;
    uint8_t spcr;
    uint8_t spsr;
    /* Number of bytes that the program sent since chip select fell, and the first 17 of them. */
    uint8_t sent_bytes;
    uint8_t sent[FRAME_BYTES];
    uint8_t padding[3];
    /* Simulated time, and the real time skipped so far. */
    uint64_t time_us;
    uint64_t given_up_us;
    /* Number of bytes from the host that came faster than the program read them. */
    uint64_t lost_bytes;
};

/* HANG: the main loop runs in an endless loop while interrupts continue. RESTART: the chip
 * restarts. BROWN_OUT: it restarts after a dip of its supply, during which its pins float and the
 * pull-up at chip select keeps the Qube deselected. POWER_LOSS: the board loses its supply, and
 * the port is gone. CLOSE_STOP and OPEN_STOP: the contact of the emergency-stop switch. */
enum order {
    GO_ON = 0,
    HANG = 1,
    RESTART = 2,
    BROWN_OUT = 3,
    POWER_LOSS = 4,
    CLOSE_STOP = 5,
    OPEN_STOP = 6,
};

/* Start-up time of the chip after a brown-out, with Arduino's fuses. */
#define START_UP_US 65000u

struct answer {
    uint8_t order;
    uint8_t bytes[FRAME_BYTES];
};

static avr_t *avr;
static avr_uart_t *uart;
static avr_irq_t *uart_input;
static avr_irq_t *spi_input;

static bool selected;
static struct event frame;
static struct answer answer;
static enum order pending_order;
static uint64_t given_up_us;
static uint64_t lost_bytes;

/* Stop switch: its pin, and whether its contact is closed to ground. */
static avr_io_addr_t stop_register;
static uint8_t stop_mask;
static bool stop_is_closed;

/* Bytes from the host that are not yet on the line. */
static uint8_t incoming[256];
static size_t incoming_length;
static size_t incoming_at;

/* Bytes from the program, each with the cycle of its end. */
static struct {
    uint8_t byte;
    avr_cycle_count_t through;
} outgoing[256];
static uint8_t outgoing_head;
static uint8_t outgoing_tail;
static avr_cycle_count_t line_free;

static void die(const char *what)
{
    fprintf(stderr, "simulator: %s: %s\n", what, errno ? strerror(errno) : "failed");
    exit(1);
}

static void log_to_stderr(avr_t *from, const int level, const char *format, va_list arguments)
{
    if (level <= LOG_WARNING && (from == NULL || from->log >= level)) {
        vfprintf(stderr, format, arguments);
    }
}

static uint64_t now_us(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec * 1000000u + (uint64_t)now.tv_nsec / 1000u;
}

/* --- SPI --- */

static avr_spi_t *find_spi(void);

static void tell(enum event_kind kind)
{
    avr_spi_t *spi = find_spi();
    frame.kind = kind;
    frame.spcr = avr->data[spi->r_spcr];
    frame.spsr = avr->data[spi->r_spsr];
    frame.time_us = avr->cycle / CYCLES_PER_US;
    frame.given_up_us = given_up_us;
    frame.lost_bytes = lost_bytes;
    if (write(STDOUT_FILENO, &frame, sizeof frame) != (ssize_t)sizeof frame) {
        exit(0); /* the process that started this one is gone */
    }
}

static void on_chip_select(struct avr_irq_t *irq, uint32_t value, void *unused)
{
    (void)irq;
    (void)unused;
    if (value) {
        if (selected) {
            selected = false;
            tell(CHIP_SELECT_RISES);
        }
        return;
    }
    selected = true;
    memset(&frame, 0, sizeof frame);
    tell(CHIP_SELECT_FALLS);
    size_t length = 0;
    while (length < sizeof answer) {
        ssize_t part = read(STDIN_FILENO, (uint8_t *)&answer + length, sizeof answer - length);
        if (part == 0 || (part < 0 && errno != EINTR)) {
            exit(0);
        }
        length += part > 0 ? (size_t)part : 0;
    }
    if (answer.order != GO_ON) {
        pending_order = answer.order;
    }
}

static void on_spi_byte(struct avr_irq_t *irq, uint32_t value, void *unused)
{
    (void)irq;
    (void)unused;
    uint8_t received = 0xFF; /* nobody drives the line */
    if (selected) {
        if (frame.sent_bytes < FRAME_BYTES) {
            received = answer.bytes[frame.sent_bytes];
            frame.sent[frame.sent_bytes] = (uint8_t)value;
        }
        if (frame.sent_bytes < UINT8_MAX) {
            frame.sent_bytes++;
        }
    }
    avr_raise_irq(spi_input, received);
}

/* simavr ends every byte on the SPI after 101 us. This runs after its handler of a write to SPDR
 * and moves that end to the time that the prescaler gives. */
static void on_spi_start(avr_t *unused_avr, avr_io_addr_t address, uint8_t value, void *unused)
{
    (void)unused_avr;
    (void)address;
    (void)value;
    (void)unused;
    static const uint8_t DIVISOR_BITS[] = {2, 4, 6, 7}; /* SPR1 and SPR0: 4, 16, 64, 128 */
    avr_spi_t *spi = find_spi();
    uint8_t divisor_bits = DIVISOR_BITS[avr->data[spi->r_spcr] & 3u] - (avr->data[spi->r_spsr] & 1u);
    avr_cycle_count_t byte_cycles = (avr_cycle_count_t)8u << divisor_bits;
    for (avr_cycle_timer_slot_p slot = avr->cycle_timers.timer; slot; slot = slot->next) {
        if (slot->param == spi) {
            avr_cycle_timer_t end_of_byte = slot->timer;
            avr_cycle_timer_register(avr, byte_cycles, end_of_byte, spi);
            return;
        }
    }
}

static avr_io_t *find_io(const char *kind, char name)
{
    for (avr_io_t *io = avr->io_port; io; io = io->next) {
        if (!strcmp(io->kind, kind) && (!name || ((avr_uart_t *)io)->name == name)) {
            return io;
        }
    }
    errno = 0;
    die("simavr's core lacks a part");
    return NULL;
}

static avr_spi_t *find_spi(void)
{
    static avr_spi_t *spi;
    if (!spi) {
        spi = (avr_spi_t *)find_io("spi", 0);
    }
    return spi;
}

/* --- serial line --- */

static void check_baud_rate(void)
{
    uint32_t divisor = avr_regbit_get(avr, uart->u2x) ? 8u : 16u;
    uint32_t ubrr = avr_regbit_get(avr, uart->ubrrl) | avr_regbit_get(avr, uart->ubrrh) << 8;
    uint32_t rate = FREQUENCY_HZ / (divisor * (ubrr + 1u));
    if (rate != BAUD_RATE) {
        fprintf(stderr, "simulator: the program set %u baud\n", rate);
        exit(1);
    }
}

/* Moves a byte from the host to the program every CYCLES_PER_BYTE, and keeps simavr's time for the
 * program's bytes at that. */
static avr_cycle_count_t on_line_clock(avr_t *unused_avr, avr_cycle_count_t when, void *unused)
{
    (void)unused_avr;
    (void)unused;
    uart->cycles_per_byte = CYCLES_PER_BYTE;
    if (incoming_at < incoming_length && avr_regbit_get(avr, uart->rxen)) {
        check_baud_rate();
        uint8_t byte = incoming[incoming_at++];
        if (((uart->input.write - uart->input.read) & 63u) >= UART_HOLDS_BYTES) {
            avr_regbit_setto(avr, uart->dor, 1);
            lost_bytes++;
        } else {
            /* Its time on the line is over, so it arrives in the next cycle. */
            uart->cycles_per_byte = 1;
            avr_raise_irq(uart_input, byte);
            uart->cycles_per_byte = CYCLES_PER_BYTE;
        }
    }
    return when + CYCLES_PER_BYTE;
}

static void on_uart_byte(struct avr_irq_t *irq, uint32_t value, void *unused)
{
    (void)irq;
    (void)unused;
    check_baud_rate();
    if (line_free < avr->cycle) {
        line_free = avr->cycle;
    }
    line_free += CYCLES_PER_BYTE;
    outgoing[outgoing_head].byte = (uint8_t)value;
    outgoing[outgoing_head].through = line_free;
    outgoing_head++;
}

static void flush_outgoing(int master)
{
    uint8_t bytes[256];
    size_t length = 0;
    while (outgoing_tail != outgoing_head && outgoing[outgoing_tail].through <= avr->cycle) {
        bytes[length++] = outgoing[outgoing_tail++].byte;
    }
    /* A host that does not read loses bytes, as on a real line. */
    if (length && write(master, bytes, length) < 0 && errno != EAGAIN && errno != EINTR) {
        die("the pty");
    }
}

static void fill_incoming(int master)
{
    if (incoming_at < incoming_length) {
        return;
    }
    ssize_t length = read(master, incoming, sizeof incoming);
    incoming_at = 0;
    incoming_length = length > 0 ? (size_t)length : 0;
}

static int open_line(int *slave)
{
    int master;
    char path[256];
    struct termios settings;
    if (openpty(&master, slave, path, NULL, NULL) < 0 || tcgetattr(*slave, &settings) < 0) {
        die("no pty");
    }
    cfmakeraw(&settings);
    tcsetattr(*slave, TCSANOW, &settings);
    fcntl(master, F_SETFL, O_NONBLOCK);
    printf("%s\n", path);
    fflush(stdout);
    return master;
}

/* --- the program --- */

static void load(const char *elf, const char *mcu, uint32_t memory_seed)
{
    elf_firmware_t firmware;
    memset(&firmware, 0, sizeof firmware);
    errno = 0;
    if (elf_read_firmware(elf, &firmware) < 0) {
        die(elf);
    }
    firmware.frequency = FREQUENCY_HZ;
    avr = avr_make_mcu_by_name(mcu);
    if (!avr) {
        die(mcu);
    }
    avr_init(avr);
    avr_load_firmware(avr, &firmware);
    for (uint32_t at = avr->ioend + 1u; at <= avr->ramend; at++) {
        memory_seed = memory_seed * 1664525u + 1013904223u;
        avr->data[at] = (uint8_t)(memory_seed >> 24);
    }
    uart = (avr_uart_t *)find_io("uart", '0');

    /* By default simavr sleeps while a program polls its UART, and prints the program's output. */
    uint32_t flags = 0;
    avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
    uart_input = avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT),
                            on_uart_byte, NULL);
    spi_input = avr_io_getirq(avr, AVR_IOCTL_SPI_GETIRQ(find_spi()->name), SPI_IRQ_INPUT);
    avr_irq_register_notify(
        avr_io_getirq(avr, AVR_IOCTL_SPI_GETIRQ(find_spi()->name), SPI_IRQ_OUTPUT), on_spi_byte,
        NULL);
    avr_register_io_write(avr, find_spi()->r_spdr, on_spi_start, NULL);
    int chip_select = strcmp(mcu, "atmega2560") ? 2 : 0;
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('B'), chip_select),
                            on_chip_select, NULL);
    /* D2 of either board: PIND bit 2, PINE bit 4. */
    stop_register = strcmp(mcu, "atmega2560") ? 0x29 : 0x2C;
    stop_mask = strcmp(mcu, "atmega2560") ? 1u << 2 : 1u << 4;
}

static void no_sleep(avr_t *unused_avr, avr_cycle_count_t unused)
{
    (void)unused_avr;
    (void)unused;
}

/* Makes the program hang in a loop of one instruction, `rjmp .-2`, at the end of flash. */
static void hang(void)
{
    avr_flashaddr_t trap = avr->flashend - 1u;
    avr->flash[trap] = 0xFF;
    avr->flash[trap + 1] = 0xCF;
    avr->pc = trap;
    avr->state = cpu_Running;
}

/* Restarts the chip after `dark_us`. simavr restarts its cycle count then, but time continues. */
static void restart(uint64_t dark_us)
{
    avr_cycle_count_t now = avr->cycle;
    avr_reset(avr);
    avr->cycle = now + dark_us * CYCLES_PER_US;
    incoming_at = incoming_length;
    outgoing_tail = outgoing_head;
    line_free = 0;
}

/* An open contact leaves the pin to its pull-up. simavr would report that only once, when the
 * program enables the pull-up. */
static void drive_stop_pin(void)
{
    if (stop_is_closed) {
        avr->data[stop_register] &= (uint8_t)~stop_mask;
    } else {
        avr->data[stop_register] |= stop_mask;
    }
}

static void obey(void)
{
    enum order order = pending_order;
    if (order == GO_ON || (order == HANG && !avr->sreg[S_I])) {
        /* The main loop must hang, not an interrupt. */
        return;
    }
    if ((order == RESTART || order == BROWN_OUT) && selected) {
        return; /* nobody knows how a Qube reads half a frame */
    }
    pending_order = GO_ON;
    switch (order) {
    case HANG:
        hang();
        break;
    case RESTART:
        restart(0);
        break;
    case BROWN_OUT:
        restart(START_UP_US);
        break;
    case POWER_LOSS:
        exit(0);
    case CLOSE_STOP:
    case OPEN_STOP:
        stop_is_closed = order == CLOSE_STOP;
        break;
    default:
        break;
    }
}

static void run_until(avr_cycle_count_t target)
{
    drive_stop_pin();
    if (!avr_cycle_timer_status(avr, on_line_clock, NULL)) {
        /* At the start, and after a restart of the chip, which clears all of simavr's timers. */
        avr_cycle_timer_register(avr, CYCLES_PER_BYTE, on_line_clock, NULL);
    }
    while (avr->cycle < target) {
        obey();
        int state = avr_run(avr);
        if (state == cpu_Done || state == cpu_Crashed) {
            fprintf(stderr, "simulator: the program has ended\n");
            exit(1);
        }
    }
}

int main(int count, char **arguments)
{
    if (count != 4) {
        fprintf(stderr, "usage: simulator ELF atmega328p|atmega2560 MEMORY_SEED\n");
        return 2;
    }
    avr_global_logger_set(log_to_stderr);
    load(arguments[1], arguments[2], (uint32_t)strtoul(arguments[3], NULL, 0));
    avr->log = LOG_ERROR;
    avr->sleep = no_sleep;
    int slave;
    int master = open_line(&slave);

    /* The process stands for a chip, which nothing delays. Without real-time priority it skips
     * time more often. */
    struct sched_param priority = {.sched_priority = 1};
    sched_setscheduler(0, SCHED_FIFO | SCHED_RESET_ON_FORK, &priority);

    uint64_t start_us = now_us();
    uint64_t housekeeping_us = 0;
    for (;;) {
        uint64_t elapsed_us = now_us() - start_us;
        uint64_t simulated_us = avr->cycle / CYCLES_PER_US;
        if (elapsed_us > simulated_us + MAX_BEHIND_US) {
            uint64_t excess_us = elapsed_us - simulated_us - MAX_BEHIND_US;
            given_up_us += excess_us;
            start_us += excess_us;
            elapsed_us -= excess_us;
        }
        run_until((avr_cycle_count_t)elapsed_us * CYCLES_PER_US);
        flush_outgoing(master);
        fill_incoming(master);
        if (elapsed_us >= housekeeping_us) {
            /* A killed host leaves the port exclusive: nobody could open it while the pty lives. */
            ioctl(slave, TIOCNXCL);
            housekeeping_us = elapsed_us + HOUSEKEEPING_US;
        }
        uint64_t next_us = elapsed_us + SLICE_US;
        uint64_t now = now_us() - start_us;
        if (now < next_us) {
            struct timespec wait = {.tv_nsec = (long)(next_us - now) * 1000};
            /* While a byte waits for the line there is no other reason to wake. */
            struct pollfd ready[] = {
                {.fd = STDIN_FILENO, .events = 0},
                {.fd = incoming_at < incoming_length ? -1 : master, .events = POLLIN},
            };
            if (ppoll(ready, 2, &wait, NULL) > 0 && (ready[0].revents & (POLLHUP | POLLERR))) {
                return 0;
            }
        }
    }
}
