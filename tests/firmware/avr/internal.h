/* SPDX-License-Identifier: GPL-3.0-or-later
 * What the parts of the bench share; bench.h says what this program is. */
#ifndef INTERNAL_H
#define INTERNAL_H

#include "bench.h"

#include <simavr/sim_avr.h>

#include <simavr/avr_ioport.h>
#include <simavr/sim_io.h>

#define LINE 8192   /* bytes of a UART queue */

typedef struct {
    int port_x, bit_x, port_b, bit_b;
    double rate, place;              /* counts/s; counts at `since` */
    avr_cycle_count_t since;
    int64_t count;
} wheel_t;

struct bench {
    avr_t *avr;
    avr_io_t module;                 /* tells of resets */
    uint64_t epoch;                  /* cycles before the last reset */
    uint64_t before_reset;           /* avr->cycle when the last step began */
    int was_reset, own_reset;
    uint32_t resets;
    uint64_t reset_at;
    uint8_t reset_flags;

    int exact, slept;
    int off;                         /* interrupts are off */
    uint64_t off_since;
    uint32_t off_longest;

    /* twi.c */
    avr_int_vector_t *twi_vector;
    uint32_t bit_cycles;
    int receiving, transmitting;     /* addressed by the master */
    int scl_held;                    /* TWINT of an event during a transfer */
    uint64_t event_at;
    bench_i2c_t i2c;

    /* uart.c */
    avr_irq_t *uart_in;
    uint8_t rx[LINE], tx[LINE];
    uint64_t tx_at[LINE];
    unsigned rx_in, rx_out, tx_in, tx_out;
    int feeding;

    /* board.c */
    uint8_t driven[8], level[8];     /* pins driven from outside, by port letter - 'A' */
    uint16_t tone_top, tone_compare;

    wheel_t wheel[2];
};

int bench_step(bench_t *b);                          /* some instructions, or sleep to the next event */

void twi_attach(bench_t *b);
void twi_reset(bench_t *b);
void uart_attach(bench_t *b);
void uart_reset(bench_t *b);
void board_attach(bench_t *b);
void board_reset(bench_t *b);
void encoders_attach(bench_t *b);
void encoders_reset(bench_t *b);

#endif
