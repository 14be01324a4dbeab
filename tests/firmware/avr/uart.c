/* SPDX-License-Identifier: GPL-3.0-or-later
 * USART1 from the other end: bytes towards the chip at 115200 baud, and what it sends with the time it came.
 * simavr's receiver has a queue of 64 bytes and never overruns: the firmware's own margins are tested otherwise. */
#include "internal.h"

#include <simavr/avr_uart.h>

#define BYTE_CYCLES 1389   /* ten bits at 115200 baud */

static void sent(avr_irq_t *irq, uint32_t value, void *param)
{
    bench_t *b = param;
    (void)irq;
    if (b->tx_in - b->tx_out < LINE) {
        b->tx[b->tx_in % LINE] = (uint8_t)value;
        b->tx_at[b->tx_in++ % LINE] = bench_now(b);
    }
}

static avr_cycle_count_t feed(avr_t *avr, avr_cycle_count_t when, void *param)
{
    bench_t *b = param;
    (void)avr;
    avr_raise_irq(b->uart_in, b->rx[b->rx_out++ % LINE]);
    b->feeding = b->rx_in != b->rx_out;
    return b->feeding ? when + BYTE_CYCLES : 0;
}

static void go_on(bench_t *b)
{
    if (b->feeding || b->rx_in == b->rx_out)
        return;
    b->feeding = 1;
    avr_cycle_timer_register(b->avr, BYTE_CYCLES, feed, b);
}

void uart_attach(bench_t *b)
{
    b->uart_in = avr_io_getirq(b->avr, AVR_IOCTL_UART_GETIRQ('1'), UART_IRQ_INPUT);
    avr_irq_register_notify(avr_io_getirq(b->avr, AVR_IOCTL_UART_GETIRQ('1'), UART_IRQ_OUTPUT), sent, b);
}

void uart_reset(bench_t *b)
{
    /* No echo to the terminal, no sleeping while polled. */
    uint32_t flags = 0;
    avr_ioctl(b->avr, AVR_IOCTL_UART_SET_FLAGS('1'), &flags);
    b->feeding = 0;
    go_on(b);
}

void bench_uart_feed(bench_t *b, const uint8_t *bytes, size_t count)
{
    for (size_t i = 0; i < count && b->rx_in - b->rx_out < LINE; i++)
        b->rx[b->rx_in++ % LINE] = bytes[i];
    go_on(b);
}

size_t bench_uart_take(bench_t *b, uint8_t *bytes, uint64_t *when, size_t most)
{
    size_t count = 0;
    for (; count < most && b->tx_in != b->tx_out; count++) {
        when[count] = b->tx_at[b->tx_out % LINE];
        bytes[count] = b->tx[b->tx_out++ % LINE];
    }
    return count;
}

int bench_uart_busy(const bench_t *b)
{
    return b->feeding;
}
