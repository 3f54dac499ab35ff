/* The board layer for Arduino Uno and Nano (ATmega328P) and Mega (ATmega2560), all at 16 MHz.
 *
 * UART0 connects to the board's USB converter, SPI to the Qube; timer 1 is clock and sampling
 * timer. The EEPROM holds boot number, serial number, and whether there is an emergency-stop
 * switch. */
#include "board.h"

#include <avr/boot.h>
#include <avr/eeprom.h>
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>
#include <avr/wdt.h>
#include <stddef.h>
#include <string.h>
#include <util/atomic.h>
#include <util/crc16.h>
#include <util/delay.h>

#include "wire.h"

/* Chip select is the pin SS, which as an output cannot switch the SPI out of master mode. */
#if defined(__AVR_ATmega328P__)
const uint8_t BOARD_KIND = KIND_ATMEGA328P;
#define PIN_CHIP_SELECT _BV(PB2) /* D10 */
#define PIN_MOSI _BV(PB3)        /* D11 */
#define PIN_MISO _BV(PB4)        /* D12 */
#define PIN_CLOCK _BV(PB5)       /* D13 */
#define USART_RECEIVED_vect USART_RX_vect
#define USART_SEND_vect USART_UDRE_vect
#define STOP_PORT PORTD
#define STOP_PIN PIND
#define STOP_BIT _BV(PD2) /* D2 */
#elif defined(__AVR_ATmega2560__)
const uint8_t BOARD_KIND = KIND_ATMEGA2560;
#define PIN_CHIP_SELECT _BV(PB0) /* D53 */
#define PIN_CLOCK _BV(PB1)       /* D52 */
#define PIN_MOSI _BV(PB2)        /* D51 */
#define PIN_MISO _BV(PB3)        /* D50 */
#define USART_RECEIVED_vect USART0_RX_vect
#define USART_SEND_vect USART0_UDRE_vect
#define STOP_PORT PORTE
#define STOP_PIN PINE
#define STOP_BIT _BV(PE4) /* D2 */
#else
#error "this board has no pin table yet"
#endif

/* Double speed: UBRR = 3 gives exactly 500 000 baud. */
#define UBRR_VALUE (F_CPU / 8ul / BAUD_RATE - 1ul)
#if F_CPU / 8ul / (UBRR_VALUE + 1ul) != BAUD_RATE
#error "this clock does not divide down to the baud rate"
#endif

/* Timer 1 counts half microseconds and restarts with every sampling period. */
#define TICKS_PER_US 2u
#define SAMPLING_PERIOD_US 2000u
#define SAMPLING_PERIOD_TICKS (SAMPLING_PERIOD_US * TICKS_PER_US)
#if F_CPU != 8ul * TICKS_PER_US * 1000000ul
#error "the timer's prescaler is for 16 MHz"
#endif

/* Mode 2 (clock idles high, data sampled at its falling edge), MSB first, 16 MHz / 16 = 1 MHz. */
#define SPI_SETTINGS (_BV(SPE) | _BV(MSTR) | _BV(CPOL) | _BV(SPR0))

/* Powers of two, so that an index wraps by a mask. */
#define RECEIVE_RING_BYTES 128u
#define SEND_RING_BYTES 128u

/* Set by each interrupt after which the main loop may have work. */
static volatile bool has_event;

static volatile uint32_t period_start_us;
static volatile bool sampling_is_due;

static volatile uint8_t receive_ring[RECEIVE_RING_BYTES];
static volatile uint8_t receive_head;
static volatile uint8_t receive_tail;
/* True where bytes were lost directly before the byte at the same place of the ring, or where that
 * byte is garbled. The interrupt sets and the main loop clears a place, never both at one time:
 * the interrupt's place holds no byte yet. */
static volatile bool lost_before[RECEIVE_RING_BYTES];

static volatile uint8_t send_ring[SEND_RING_BYTES];
static volatile uint8_t send_head;
static volatile uint8_t send_tail;

static volatile uint8_t qube_command[QUBE_FRAME_BYTES];
static volatile uint8_t qube_answer[QUBE_FRAME_BYTES];
/* Index of the byte in transfer. */
static volatile uint8_t qube_index;
static volatile bool qube_busy;
static volatile bool qube_ended;

/* Persistent data. An EEPROM that was never written is all ones. */
static struct {
    uint16_t boot_number;
    uint8_t serial[8];
    uint16_t serial_crc;
    uint8_t stop_switch;
} stored EEMEM;

/* Value of `stop_switch` on a board that has an emergency-stop switch. */
#define STOP_SWITCH_KNOWN 0x53u

/* `make STOP_SWITCH=never`: D2 is ignored, and a stored switch is forgotten. */
#ifndef STOP_SWITCH_NEVER
#define STOP_SWITCH_NEVER 0
#endif

/* Symbol of the linker: the beginning of the memory without variables. */
extern uint8_t __heap_start;

/* After a restart by the watchdog, the watchdog still runs, with its shortest time. So it is
 * switched off before `main` begins. */
static void stop_watchdog_early(void) __attribute__((naked, used, section(".init3")));
static void stop_watchdog_early(void)
{
    MCUSR = 0;
    wdt_disable();
}

/* --- clock --- */

ISR(TIMER1_COMPA_vect)
{
    period_start_us += SAMPLING_PERIOD_US;
    sampling_is_due = true;
    has_event = true;
}

/* Microseconds since the start, modulo 2^32. The caller must have switched interrupts off. */
static uint32_t time_us(void)
{
    uint16_t ticks = TCNT1;
    uint32_t start_us = period_start_us;
    if (TIFR1 & _BV(OCF1A)) {
        /* The timer has begun a new period, perhaps after it was read, and its interrupt is
         * pending. */
        ticks = TCNT1;
        start_us += SAMPLING_PERIOD_US;
    }
    return start_us + ticks / TICKS_PER_US;
}

uint32_t board_time_us(void)
{
    uint32_t now_us;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        now_us = time_us();
    }
    return now_us;
}

bool board_sampling_is_due(void)
{
    /* Cleared only if it was set, because the interrupt may set it in between. */
    if (!sampling_is_due) {
        return false;
    }
    sampling_is_due = false;
    return true;
}

/* --- serial port --- */

ISR(USART_RECEIVED_vect)
{
    uint8_t status = UCSR0A;
    uint8_t byte = UDR0;
    uint8_t head = (receive_head + 1u) & (RECEIVE_RING_BYTES - 1u);
    if ((status & (_BV(FE0) | _BV(DOR0))) || head == receive_tail) {
        lost_before[receive_head] = true;
    }
    if (head != receive_tail) {
        receive_ring[receive_head] = byte;
        receive_head = head;
    }
    has_event = true;
}

ISR(USART_SEND_vect)
{
    if (send_tail == send_head) {
        UCSR0B &= ~_BV(UDRIE0);
    } else {
        UDR0 = send_ring[send_tail];
        send_tail = (send_tail + 1u) & (SEND_RING_BYTES - 1u);
    }
    has_event = true;
}

bool board_receive(uint8_t *byte, bool *after_loss)
{
    uint8_t tail = receive_tail;
    if (tail == receive_head) {
        return false;
    }
    *byte = receive_ring[tail];
    *after_loss = lost_before[tail];
    lost_before[tail] = false;
    receive_tail = (tail + 1u) & (RECEIVE_RING_BYTES - 1u);
    return true;
}

uint8_t board_send_room(void)
{
    return (send_tail - send_head - 1u) & (SEND_RING_BYTES - 1u);
}

void board_send(const uint8_t *bytes, uint8_t length)
{
    uint8_t head = send_head;
    for (uint8_t i = 0; i < length; i++) {
        send_ring[head] = bytes[i];
        head = (head + 1u) & (SEND_RING_BYTES - 1u);
    }
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        send_head = head;
        UCSR0B |= _BV(UDRIE0);
    }
}

/* --- the Qube --- */

static uint8_t next_byte(uint8_t index)
{
    return qube_frame_byte((const uint8_t *)qube_command, (const uint8_t *)qube_answer, index);
}

ISR(SPI_STC_vect)
{
    uint8_t index = qube_index;
    qube_answer[index++] = SPDR;
    if (index < QUBE_FRAME_BYTES) {
        qube_index = index;
        SPDR = next_byte(index);
        return;
    }
    PORTB |= PIN_CHIP_SELECT;
    qube_busy = false;
    qube_ended = true;
    has_event = true;
}

bool board_qube_is_busy(void)
{
    /* Also busy until the program has seen the end of a frame, because the next frame would
     * overwrite its answer. The interrupt that clears `qube_busy` also sets `qube_ended`. */
    return qube_busy || qube_ended;
}

uint32_t board_qube_begin(const uint8_t command[QUBE_FRAME_BYTES])
{
    uint32_t began_us;
    memcpy((uint8_t *)qube_command, command, QUBE_FRAME_BYTES);
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        qube_busy = true;
        qube_index = 0;
        began_us = time_us();
        PORTB &= ~PIN_CHIP_SELECT;
        SPDR = qube_command[0];
    }
    return began_us;
}

bool board_qube_ended(uint8_t answer[QUBE_FRAME_BYTES])
{
    if (!qube_ended) {
        return false;
    }
    qube_ended = false;
    memcpy(answer, (const uint8_t *)qube_answer, QUBE_FRAME_BYTES);
    return true;
}

/* --- the chip's own watchdog --- */

/* Sends one frame with the motor word 0x0000, byte by byte without interrupts. It needs neither
 * the main loop nor settings of the SPI, only the directions of the pins. */
static void send_off_frame(void)
{
    static const struct qube_command OFF = {
        .write_mask = QUBE_WRITE_ALL, .red = QUBE_LED_MAX, .motor_word = MOTOR_OFF};
    uint8_t bytes[QUBE_FRAME_BYTES];
    SPCR = SPI_SETTINGS;
    SPSR = 0;
    PORTB |= PIN_CHIP_SELECT;
    _delay_us(10); /* a byte that was on its way has left the shift register */
    (void)SPSR;
    (void)SPDR;
    qube_frame_encode(&OFF, bytes);
    PORTB &= ~PIN_CHIP_SELECT;
    for (uint8_t i = 0; i < QUBE_FRAME_BYTES; i++) {
        SPDR = bytes[i];
        while (!(SPSR & _BV(SPIF))) {
        }
    }
    PORTB |= PIN_CHIP_SELECT;
    (void)SPDR;
}

void board_switch_qube_off(void)
{
    /* Set high before it becomes an output, because chip select must not fall. */
    PORTB |= PIN_CHIP_SELECT | PIN_CLOCK;
    DDRB |= PIN_CHIP_SELECT | PIN_CLOCK | PIN_MOSI;
    DDRB &= ~PIN_MISO;
    send_off_frame();
}

/* Runs when the program hangs. The Qube would keep its last motor word through the restart and
 * through a boot loader (some on the Mega never get past a restart by the watchdog). So one frame
 * switches its motor off first. No other interrupt waits; this one does, for 0.2 ms, because a
 * program that hangs cannot be delayed. At the watchdog's second time-out, 16 ms later, the chip
 * restarts. If the program hangs with interrupts disabled, the chip restarts without this frame,
 * and the program's first frame switches the motor off. */
ISR(WDT_vect)
{
    send_off_frame();
    for (;;) {
    }
}

static void start_watchdog(void)
{
    wdt_reset();
    WDTCSR = _BV(WDCE) | _BV(WDE);
    /* First time-out: interrupt. Second time-out: restart. 16 ms each. */
    WDTCSR = _BV(WDIE) | _BV(WDE);
}

void board_feed_hardware_watchdog(void)
{
    wdt_reset();
}

/* --- EEPROM, emergency stop, start and sleep --- */

uint16_t board_next_boot_number(void)
{
    uint16_t number = eeprom_read_word(&stored.boot_number) + 1u;
    eeprom_update_word(&stored.boot_number, number);
    return number;
}

static uint16_t crc_of(const uint8_t serial[8])
{
    uint16_t crc = 0xFFFFu;
    for (uint8_t i = 0; i < 8; i++) {
        crc = _crc_ccitt_update(crc, serial[i]);
    }
    return crc;
}

/* Draws eight bytes that differ between boards. The content of unused memory at power-on differs
 * from chip to chip in a few of a hundred cells. The signature row holds lot, wafer and position on
 * chips that store them. The bytes are four checksums of both. */
static void draw_serial(uint8_t serial[8])
{
    uint16_t checksums[4] = {0xFFFFu, 0xFFFFu, 0xFFFFu, 0xFFFFu};
    uint8_t index = 0;
    for (const uint8_t *at = &__heap_start; at < (const uint8_t *)SP - 32; at++) {
        checksums[index] = _crc_ccitt_update(checksums[index], *at);
        index = (index + 1u) & 3u;
    }
    for (uint8_t at = 0x0E; at <= 0x17; at++) {
        checksums[index] = _crc_ccitt_update(checksums[index], boot_signature_byte_get(at));
        index = (index + 1u) & 3u;
    }
    memcpy(serial, checksums, 8);
}

void board_serial(uint8_t serial[8])
{
    eeprom_read_block(serial, stored.serial, 8);
    if (crc_of(serial) == eeprom_read_word(&stored.serial_crc)) {
        return;
    }
    draw_serial(serial);
    eeprom_update_block(serial, stored.serial, 8);
    eeprom_update_word(&stored.serial_crc, crc_of(serial));
    eeprom_busy_wait();
}

bool board_stop_switch_is_closed(void)
{
    return !STOP_SWITCH_NEVER && !(STOP_PIN & STOP_BIT);
}

bool board_stop_switch_is_known(void)
{
    if (STOP_SWITCH_NEVER) {
        eeprom_update_byte(&stored.stop_switch, 0xFFu);
    }
    return eeprom_read_byte(&stored.stop_switch) == STOP_SWITCH_KNOWN;
}

void board_remember_stop_switch(void)
{
    eeprom_update_byte(&stored.stop_switch, STOP_SWITCH_KNOWN);
}

void board_start(void)
{
    SPCR = SPI_SETTINGS | _BV(SPIE);

    /* Input with its pull-up: a broken wire reads as an open contact. */
    STOP_PORT |= STOP_BIT;

    UCSR0A = _BV(U2X0);
    UBRR0 = UBRR_VALUE;
    UCSR0C = _BV(UCSZ01) | _BV(UCSZ00);
    UCSR0B = _BV(RXCIE0) | _BV(RXEN0) | _BV(TXEN0);

    OCR1A = SAMPLING_PERIOD_TICKS - 1u;
    TIMSK1 = _BV(OCIE1A);
    TCCR1A = 0;
    TCCR1B = _BV(WGM12) | _BV(CS11);

    set_sleep_mode(SLEEP_MODE_IDLE);
    start_watchdog();
    sei();
}

void board_sleep(void)
{
    cli();
    if (!has_event) {
        sleep_enable();
        /* The instruction after sei runs before any interrupt. */
        sei();
        sleep_cpu();
        sleep_disable();
    }
    has_event = false;
    sei();
}
