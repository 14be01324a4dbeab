/* SPDX-License-Identifier: GPL-3.0-or-later
 * I2C: the slave's hardware and a master to talk to it.
 *
 * The TWI slave of simavr 1.6 reports wrong states (SLA+W as 0x80, STOP as 0xA8, nothing after a byte sent). So the
 * hooks of TWCR, TWDR and TWSR are taken over, and the slave of the ATmega32U4 datasheet 20 is built here: a
 * state is shown with TWINT, SCL is held until the firmware clears it. The master clocks bits at its speed and waits
 * for SCL, as any I2C master does. Each call is one transaction. */
#include "internal.h"

#include <string.h>

enum { R_TWSR = 0xB9, R_TWAR = 0xBA, R_TWDR = 0xBB, R_TWCR = 0xBC, R_TWAMR = 0xBD };
enum { TWIE = 1, TWEN = 4, TWSTO = 16, TWEA = 64, TWINT = 128 };
enum { TWI_VECTOR = 36 };
enum { SLA_W = 0x60, GENERAL = 0x70, GOT_ACK = 0x80, GOT_NACK = 0x88, STOPPED = 0xA0,
       SLA_R = 0xA8, SENT_ACK = 0xB8, SENT_NACK = 0xC0, SENT_LAST = 0xC8, NOTHING = 0xF8 };
#define PATIENCE 400000u   /* 25 ms, as SMBus */

static uint8_t control(const bench_t *b) { return b->avr->data[R_TWCR]; }
static int acknowledges(const bench_t *b) { return (control(b) & (TWEN | TWEA)) == (TWEN | TWEA); }

static void show(bench_t *b, uint8_t state)
{
    avr_t *avr = b->avr;
    avr->data[R_TWSR] = (uint8_t)((avr->data[R_TWSR] & 7) | state);
    b->event_at = bench_now(b);
    avr_raise_interrupt(avr, b->twi_vector);
    avr->data[R_TWCR] |= TWINT;
}

static void released(bench_t *b)
{
    if (!b->scl_held)
        return;
    uint32_t held = (uint32_t)(bench_now(b) - b->event_at);
    b->scl_held = 0;
    b->i2c.stretch_total += held;
    if (held > b->i2c.stretch_longest)
        b->i2c.stretch_longest = held;
    if (b->i2c.stretch_shortest == 0 || held < b->i2c.stretch_shortest)
        b->i2c.stretch_shortest = held;
}

static void write_twcr(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param)
{
    bench_t *b = param;
    uint8_t pending = avr->data[R_TWCR] & TWINT;
    (void)address;
    if ((value & TWINT) || !(value & TWEN)) {
        if (pending) {
            avr_clear_interrupt(avr, b->twi_vector);
            released(b);
        }
        pending = 0;
        avr->data[R_TWSR] = (uint8_t)((avr->data[R_TWSR] & 7) | NOTHING);
    }
    if (!(value & TWEN))
        b->receiving = b->transmitting = 0;   /* the pins are given back (datasheet 20, TWCR) */
    avr->data[R_TWCR] = (uint8_t)((value & (TWIE | TWEN | TWEA)) | pending);
    if (pending && (value & TWIE))
        avr_raise_interrupt(avr, b->twi_vector);
}

static void write_twdr(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param)
{
    (void)param;
    avr->data[address] = value;
}

static uint8_t read_twdr(avr_t *avr, avr_io_addr_t address, void *param)
{
    (void)param;
    return avr->data[address];
}

static void write_twsr(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param)
{
    (void)param;
    avr->data[address] = (uint8_t)((avr->data[address] & 0xF8) | (value & 3));
}

void twi_attach(bench_t *b)
{
    avr_t *avr = b->avr;
    for (int i = 0; i < avr->interrupts.vector_count; i++)
        if (avr->interrupts.vector[i]->vector == TWI_VECTOR)
            b->twi_vector = avr->interrupts.vector[i];
    avr->io[AVR_DATA_TO_IO(R_TWCR)].w.c = write_twcr;
    avr->io[AVR_DATA_TO_IO(R_TWCR)].w.param = b;
    avr->io[AVR_DATA_TO_IO(R_TWDR)].w.c = write_twdr;
    avr->io[AVR_DATA_TO_IO(R_TWDR)].w.param = b;
    avr->io[AVR_DATA_TO_IO(R_TWDR)].r.c = read_twdr;
    avr->io[AVR_DATA_TO_IO(R_TWDR)].r.param = b;
    avr->io[AVR_DATA_TO_IO(R_TWSR)].w.c = write_twsr;
    avr->io[AVR_DATA_TO_IO(R_TWSR)].w.param = b;
    b->bit_cycles = 160;
}

void twi_reset(bench_t *b)
{
    b->avr->data[R_TWSR] = NOTHING;
    b->receiving = b->transmitting = b->scl_held = 0;
}

static int bits(bench_t *b, unsigned count)
{
    return bench_run_to(b, bench_now(b) + (uint64_t)count * b->bit_cycles) ? I2C_CRASHED : 0;
}

/* An event while SCL is low: the slave holds it until TWINT is cleared. */
static int event(bench_t *b, uint8_t state)
{
    uint64_t limit = bench_now(b) + PATIENCE;
    b->scl_held = 1;
    show(b, state);
    while (control(b) & TWINT) {
        if (bench_step(b))
            return I2C_CRASHED;
        if (bench_now(b) > limit)
            return I2C_STRETCHED_TOO_LONG;
    }
    return 0;
}

/* A slave in the middle of sending a 0 holds SDA low: no master can make a START. */
static int sda_held(const bench_t *b)
{
    return b->transmitting && !(b->avr->data[R_TWDR] & 0x80);
}

static int start(bench_t *b, uint8_t address, int reading)
{
    avr_t *avr = b->avr;
    int result;
    if (sda_held(b))
        return I2C_BUS_HELD;
    b->transmitting = 0;
    if ((result = bits(b, 1)))
        return result;
    if (b->receiving) {
        b->receiving = 0;
        if ((result = event(b, STOPPED)))    /* a repeated START counts as a STOP; SCL is low after it */
            return result;
    }
    int deaf = (control(b) & TWINT) != 0;   /* a STOP still being handled: the address passes unheard */
    if ((result = bits(b, 9)))
        return result;
    uint8_t mask = (uint8_t)~(avr->data[R_TWAMR] >> 1) & 0x7F;
    int general = address == 0 && !reading && (avr->data[R_TWAR] & 1);
    int match = ((address ^ (avr->data[R_TWAR] >> 1)) & mask) == 0 || general;
    if (match && deaf)
        b->i2c.deaf++;
    if (deaf || !match || !acknowledges(b)) {
        b->i2c.refused++;
        return I2C_NO_ADDRESS;
    }
    b->receiving = !reading;
    b->transmitting = reading;
    return event(b, reading ? SLA_R : general ? GENERAL : SLA_W);
}

static int stop(bench_t *b)
{
    int result = bits(b, 1);
    b->transmitting = 0;
    if (b->receiving) {
        b->receiving = 0;
        show(b, STOPPED);   /* the bus is free: nobody waits for this */
    }
    return result;
}

int bench_i2c_write(bench_t *b, uint8_t address, const uint8_t *bytes, size_t count, int with_stop)
{
    int result = start(b, address, 0);
    int done = 0;
    b->i2c.transfers++;
    for (size_t i = 0; result == 0 && i < count; i++) {
        if ((result = bits(b, 9)))
            break;
        int ack = acknowledges(b);
        b->avr->data[R_TWDR] = bytes[i];
        if (!ack) {
            b->receiving = 0;
            b->i2c.refused++;
        }
        result = event(b, ack ? GOT_ACK : GOT_NACK);
        if (!ack)
            break;
        b->i2c.bytes++;
        done++;
    }
    if (result == I2C_BUS_HELD)
        return result;
    if (with_stop || result != 0 || done < (int)count) {
        int stopped = stop(b);
        if (result == 0)
            result = stopped;
    }
    return result ? result : done;
}

int bench_i2c_read(bench_t *b, uint8_t address, uint8_t *bytes, size_t count, int with_stop)
{
    int result = start(b, address, 1);
    int done = 0;
    b->i2c.transfers++;
    for (size_t i = 0; result == 0 && i < count; i++) {
        bytes[i] = b->transmitting ? b->avr->data[R_TWDR] : 0xFF;
        if ((result = bits(b, 9)))
            break;
        int ack = i + 1 < count;
        int last = !acknowledges(b);
        if (!ack || last)
            b->transmitting = 0;
        b->i2c.bytes++;
        done++;
        result = event(b, !ack ? SENT_NACK : last ? SENT_LAST : SENT_ACK);
    }
    if (result == I2C_BUS_HELD)
        return result;
    if (with_stop || result != 0) {
        int stopped = stop(b);
        if (result == 0)
            result = stopped;
    }
    return result ? result : done;
}

int bench_i2c_wire(bench_t *b, size_t count)
{
    return bits(b, (unsigned)(2 + 9 * count));
}

int bench_i2c_abandon_read(bench_t *b, uint8_t address)
{
    return start(b, address, 1);
}

void bench_i2c_speed(bench_t *b, double hz)
{
    b->bit_cycles = (uint32_t)(b->avr->frequency / hz + 0.5);
}

void bench_i2c_stats(bench_t *b, bench_i2c_t *out)
{
    *out = b->i2c;
    memset(&b->i2c, 0, sizeof b->i2c);
}
