/* SPDX-License-Identifier: GPL-3.0-or-later
 *
 * Test bench for the firmware: an ATmega32U4 on a Balboa, simulated by libsimavr. This directory is a program of its
 * own under the GNU General Public License 3 or later, because it links libsimavr (GPL-3); see README.md. It shares no
 * code with the firmware, which it runs as an ELF file, nor with the rest of the project, which uses it over ctypes.
 *
 * A flat interface: one handle, plain numbers. Times are cycles of 62.5 ns since the bench was made; they go on through
 * resets of the chip. */
#ifndef BENCH_H
#define BENCH_H

#include <stddef.h>
#include <stdint.h>

typedef struct bench bench_t;

/* chip.c: life and time */
bench_t *bench_new(const char *elf, uint8_t mcusr);   /* NULL: no such file. mcusr: reset flags at power-on */
void bench_free(bench_t *b);
uint64_t bench_now(const bench_t *b);
int bench_run_to(bench_t *b, uint64_t cycle);         /* 0, or -1: the CPU crashed */
void bench_reset(bench_t *b, uint8_t mcusr);          /* a reset with the power on; RAM keeps its contents */
uint32_t bench_resets(const bench_t *b);              /* resets the chip made itself (watchdog) */
uint64_t bench_reset_at(const bench_t *b);            /* when the last of them came */
uint8_t bench_reset_flags(const bench_t *b);          /* MCUSR right after it */
uint8_t bench_data(const bench_t *b, uint16_t address);
void bench_poke(bench_t *b, uint16_t address, uint8_t value);
uint16_t bench_flash(const bench_t *b, uint32_t address);
void bench_set_flash(bench_t *b, uint32_t address, uint16_t word);
void bench_boot_at(bench_t *b, uint32_t address);     /* the BOOTRST fuse: where a reset starts */
uint32_t bench_pc(const bench_t *b);
int bench_to_main(bench_t *b);                        /* run on to an instruction of the main loop; its address */
int bench_asleep(const bench_t *b);
/* Longest time with interrupts off since the last call. `exact` looks at every instruction (slow); without it only
 * interrupt routines are measured. Counts from the first sleep on: start-up may be as long as it likes. */
void bench_watch(bench_t *b, int exact);
uint32_t bench_interrupts_off(bench_t *b);

/* board.c: pins, voltage, timers */
void bench_pin_in(bench_t *b, char port, int bit, int level);
int bench_pin_out(const bench_t *b, char port, int bit);       /* -1: an input */
void bench_battery(bench_t *b, uint32_t adc_millivolts);
double bench_motor(const bench_t *b, int side);                 /* 0 left, 1 right: signed duty; 2: not set up */
double bench_pwm_hz(const bench_t *b);
double bench_tone_hz(const bench_t *b);                         /* 0: silent */
double bench_tone_duty(const bench_t *b);

/* encoders.c: 0 left, 1 right */
void bench_wheel(bench_t *b, int side, double counts_per_second);
int64_t bench_counts(const bench_t *b, int side);
void bench_encoder_glitch(bench_t *b, int side);                /* both channels change at once */

/* uart.c: the DWM1001's end of the line */
void bench_uart_feed(bench_t *b, const uint8_t *bytes, size_t count);
size_t bench_uart_take(bench_t *b, uint8_t *bytes, uint64_t *when, size_t most);   /* what the firmware sent */
int bench_uart_busy(const bench_t *b);

/* usb.c: the USB host. Results: bytes sent or read, or one of these */
enum { USB_BUSY = -2, USB_REFUSED = -3 };
void bench_usb_power(bench_t *b, int on);                       /* 5 V on the cable */
void bench_usb_bus_reset(bench_t *b);
int bench_usb_setup(bench_t *b, const uint8_t *request);        /* 8 bytes */
int bench_usb_out(bench_t *b, uint8_t endpoint, const uint8_t *bytes, size_t count);
int bench_usb_in(bench_t *b, uint8_t endpoint, uint8_t *bytes, size_t most);

/* twi.c: the I2C master. Results: bytes acknowledged or read, or one of these */
enum { I2C_NO_ADDRESS = -1, I2C_STRETCHED_TOO_LONG = -2, I2C_CRASHED = -3, I2C_BUS_HELD = -4 };
typedef struct {
    uint64_t transfers, bytes;
    uint64_t refused;            /* addresses and bytes not acknowledged */
    uint64_t deaf;               /* addresses missed because the STOP before was still being handled */
    uint32_t stretch_longest, stretch_shortest;   /* cycles SCL was held by the slave */
    uint64_t stretch_total;
} bench_i2c_t;
void bench_i2c_speed(bench_t *b, double hz);
int bench_i2c_write(bench_t *b, uint8_t address, const uint8_t *bytes, size_t count, int stop);
int bench_i2c_read(bench_t *b, uint8_t address, uint8_t *bytes, size_t count, int stop);
int bench_i2c_wire(bench_t *b, size_t bytes);                   /* a transfer with someone else: only takes its time */
int bench_i2c_abandon_read(bench_t *b, uint8_t address);        /* START and address, and never another clock */
void bench_i2c_stats(bench_t *b, bench_i2c_t *out);             /* and start anew */

#endif
