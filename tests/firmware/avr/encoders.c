/* SPDX-License-Identifier: GPL-3.0-or-later
 * Wheels with quadrature encoders behind the board's XOR gates. A wheel has a place in counts that moves on at its
 * rate; the whole part of it says what both channels show. Forward: B leads A. */
#include "internal.h"

static const uint8_t CHANNEL_A[4] = {0, 0, 1, 1}, CHANNEL_B[4] = {0, 1, 1, 0};

static void show(bench_t *b, wheel_t *w)
{
    int phase = (int)(w->count & 3);
    /* B before XOR, which interrupts. */
    bench_pin_in(b, (char)w->port_b, w->bit_b, CHANNEL_B[phase]);
    bench_pin_in(b, (char)w->port_x, w->bit_x, CHANNEL_A[phase] ^ CHANNEL_B[phase]);
}

/* Cycles to the next edge. Planned anew at each change of rate: an edge planned at a crawl must not hold back a run. */
static avr_cycle_count_t ahead(const bench_t *b, const wheel_t *w)
{
    double gap = w->rate > 0 ? (double)(w->count + 1) - w->place : w->place - (double)w->count;
    double cycles = gap / (w->rate > 0 ? w->rate : -w->rate) * b->avr->frequency;
    return cycles < 16 ? 16 : cycles > 1e9 ? 1000000000u : (avr_cycle_count_t)cycles;
}

static avr_cycle_count_t edge(bench_t *b, wheel_t *w, avr_cycle_count_t when)
{
    double reached = w->place + w->rate * (double)(when - w->since) / b->avr->frequency;
    w->place = w->rate > 0 ? (double)(w->count + 1) : (double)w->count;
    w->since = when;
    if ((w->rate > 0 && reached < w->place - 0.01) || (w->rate < 0 && reached > w->place + 0.01)) {
        w->place = reached;   /* a crawl: not there yet */
        return when + ahead(b, w);
    }
    w->count += w->rate > 0 ? 1 : -1;
    show(b, w);
    return when + ahead(b, w);
}

static avr_cycle_count_t left(avr_t *avr, avr_cycle_count_t when, void *param)
{
    (void)avr;
    return edge(param, &((bench_t *)param)->wheel[0], when);
}

static avr_cycle_count_t right(avr_t *avr, avr_cycle_count_t when, void *param)
{
    (void)avr;
    return edge(param, &((bench_t *)param)->wheel[1], when);
}

void bench_wheel(bench_t *b, int side, double rate)
{
    wheel_t *w = &b->wheel[side];
    avr_cycle_count_t now = b->avr->cycle;
    double place = w->place + w->rate * (double)(now - w->since) / b->avr->frequency;
    double low = (double)w->count;
    w->place = place < low ? low : place > low + 1 ? low + 1 : place;
    w->since = now;
    w->rate = rate;
    avr_cycle_timer_cancel(b->avr, side ? right : left, b);
    if (rate > 1e-9 || rate < -1e-9)
        avr_cycle_timer_register(b->avr, ahead(b, w), side ? right : left, b);
}

void encoders_attach(bench_t *b)
{
    b->wheel[0] = (wheel_t){.port_x = 'B', .bit_x = 4, .port_b = 'E', .bit_b = 2};
    b->wheel[1] = (wheel_t){.port_x = 'E', .bit_x = 6, .port_b = 'F', .bit_b = 0};
}

void encoders_reset(bench_t *b)
{
    for (int side = 0; side < 2; side++) {
        wheel_t *w = &b->wheel[side];
        w->since = b->avr->cycle;
        show(b, w);
        bench_wheel(b, side, w->rate);
    }
}

int64_t bench_counts(const bench_t *b, int side)
{
    return b->wheel[side].count;
}

void bench_encoder_glitch(bench_t *b, int side)
{
    wheel_t *w = &b->wheel[side];
    w->count += 2;
    w->place += 2;
    int phase = (int)(w->count & 3);
    /* XOR is the same after two edges: show B while XOR makes a spike short enough to be over before it is read. */
    bench_pin_in(b, (char)w->port_b, w->bit_b, CHANNEL_B[phase]);
    bench_pin_in(b, (char)w->port_x, w->bit_x, !(CHANNEL_A[phase] ^ CHANNEL_B[phase]));
    bench_pin_in(b, (char)w->port_x, w->bit_x, CHANNEL_A[phase] ^ CHANNEL_B[phase]);
}
