/* SPDX-License-Identifier: GPL-3.0-or-later
 * The board around the chip: pins, battery, motor drivers, buzzer.
 *
 * simavr 1.6 does not run timer 1 in mode 8 and has no timer 4: what reaches motors and buzzer is worked out from the
 * registers as the datasheet says (14.8, 15.8). */
#include "internal.h"

#include <simavr/avr_adc.h>

enum { R_PINB = 0x23, R_TCCR1A = 0x80, R_TCCR1B = 0x81, R_ICR1 = 0x86, R_OCR1A = 0x88, R_OCR1B = 0x8A,
       R_TC4H = 0xBF, R_TCCR4B = 0xC1, R_TCCR4C = 0xC2, R_TCCR4D = 0xC3, R_OCR4C = 0xD1, R_OCR4D = 0xD2 };

static unsigned word(const bench_t *b, int address)
{
    return b->avr->data[address] | (unsigned)b->avr->data[address + 1] << 8;
}

/* The registers of timer 4 have ten bits; the upper two go through TC4H. */
static void write_top(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param)
{
    bench_t *b = param;
    avr->data[address] = value;
    b->tone_top = (uint16_t)(value | (avr->data[R_TC4H] & 3) << 8);
}

static void write_compare(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param)
{
    bench_t *b = param;
    avr->data[address] = value;
    b->tone_compare = (uint16_t)(value | (avr->data[R_TC4H] & 3) << 8);
}

/* The chip takes a new ICR1 only while timer 1 is in a mode whose top is ICR1: 8, 10, 12 or 14 (datasheet 14, Input
 * Capture Unit). simavr always takes it. */
static void write_icr1(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param)
{
    (void)param;
    int mode = (avr->data[R_TCCR1B] >> 1 & 0x0C) | (avr->data[R_TCCR1A] & 3);
    if ((mode & 9) == 8)
        avr->data[address] = value;
}

void board_attach(bench_t *b)
{
    avr_register_io_write(b->avr, R_ICR1, write_icr1, b);
    avr_register_io_write(b->avr, R_ICR1 + 1, write_icr1, b);
    avr_register_io_write(b->avr, R_OCR4C, write_top, b);
    avr_register_io_write(b->avr, R_OCR4D, write_compare, b);
    for (const char *button = "B3D5B0"; *button; button += 2) {
        b->driven[button[0] - 'A'] |= (uint8_t)(1 << (button[1] - '0'));
        b->level[button[0] - 'A'] |= (uint8_t)(1 << (button[1] - '0'));
    }
}

/* simavr sets inputs to their pull-up whenever PORT or DDR is written, and would forget a level only raised on the
 * pin: it has to be known to the port as external too. */
static void drive(bench_t *b, int k)
{
    char port = (char)('A' + k);
    avr_ioport_external_t external = {.name = (unsigned)port, .mask = b->driven[k], .value = b->level[k]};
    avr_ioctl(b->avr, AVR_IOCTL_IOPORT_SET_EXTERNAL(port), &external);
    for (int bit = 0; bit < 8; bit++)
        if ((b->driven[k] >> bit & 1) && !(b->avr->data[R_PINB + 3 * (k - 1) + 1] >> bit & 1))
            avr_raise_irq(avr_io_getirq(b->avr, AVR_IOCTL_IOPORT_GETIRQ(port), bit), b->level[k] >> bit & 1);
}

void board_reset(bench_t *b)
{
    b->tone_top = b->tone_compare = 0;
    for (int k = 1; k < 6; k++) {
        if (!b->driven[k])
            continue;
        /* The reset cleared PINx, and a pin that is raised to the level it has anyway is not passed on. */
        uint8_t *pin = &b->avr->data[R_PINB + 3 * (k - 1)];
        *pin = (uint8_t)((*pin & ~b->driven[k]) | (b->level[k] & b->driven[k]));
        drive(b, k);
    }
}

void bench_pin_in(bench_t *b, char port, int bit, int level)
{
    int k = port - 'A';
    b->driven[k] |= (uint8_t)(1 << bit);
    b->level[k] = (uint8_t)(level ? b->level[k] | 1 << bit : b->level[k] & ~(1 << bit));
    drive(b, k);
}

int bench_pin_out(const bench_t *b, char port, int bit)
{
    int pin = R_PINB + 3 * (port - 'B');
    if (!(b->avr->data[pin + 1] >> bit & 1))
        return -1;
    return b->avr->data[pin + 2] >> bit & 1;
}

void bench_battery(bench_t *b, uint32_t adc_millivolts)
{
    avr_raise_irq(avr_io_getirq(b->avr, AVR_IOCTL_ADC_GETIRQ, 6), adc_millivolts);
}

/* Left: PWM on OC1B = PB6, direction PB2. Right: OC1A = PB5, PB1. Direction high is backward. */
double bench_motor(const bench_t *b, int side)
{
    uint8_t a = b->avr->data[R_TCCR1A];
    int mode = side ? a >> 6 & 3 : a >> 4 & 3;
    int pwm = bench_pin_out(b, 'B', side ? 5 : 6), direction = bench_pin_out(b, 'B', side ? 1 : 2);
    unsigned top = word(b, R_ICR1), compare = word(b, side ? R_OCR1A : R_OCR1B);
    if (pwm < 0)
        return 0;   /* the driver's own pull-down */
    if (mode != 2 || direction < 0 || top == 0 || bench_pwm_hz(b) == 0)
        return 2;
    double duty = compare >= top ? 1.0 : (double)compare / top;
    return direction ? -duty : duty;
}

double bench_pwm_hz(const bench_t *b)
{
    static const int prescaler[8] = {0, 1, 8, 64, 256, 1024, 0, 0};
    uint8_t a = b->avr->data[R_TCCR1A], control = b->avr->data[R_TCCR1B];
    int mode = (control >> 1 & 0x0C) | (a & 3);
    unsigned top = word(b, R_ICR1);
    if ((mode != 8 && mode != 10) || !prescaler[control & 7] || !top)
        return 0;
    return b->avr->frequency / (2.0 * prescaler[control & 7] * top);
}

double bench_tone_hz(const bench_t *b)
{
    const uint8_t *data = b->avr->data;
    int select = data[R_TCCR4B] & 15;
    int connected = (data[R_TCCR4C] & 0x0D) == 0x09 && bench_pin_out(b, 'D', 7) == 0;   /* COM4D1, PWM4D */
    if (!select || !connected || (data[R_TCCR4D] & 3) != 1 || !b->tone_top)
        return 0;
    return b->avr->frequency / (2.0 * (1 << (select - 1)) * b->tone_top);
}

double bench_tone_duty(const bench_t *b)
{
    return b->tone_top ? (double)b->tone_compare / b->tone_top : 0;
}
