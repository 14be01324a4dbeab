/* SPDX-License-Identifier: GPL-3.0-or-later
 * The USB host's end of the cable, as single transactions. simavr has the device's hardware. */
#include "internal.h"

#include <simavr/avr_usb.h>

void bench_usb_power(bench_t *b, int on)
{
    avr_ioctl(b->avr, AVR_IOCTL_USB_VBUS, (void *)(intptr_t)on);
}

void bench_usb_bus_reset(bench_t *b)
{
    avr_ioctl(b->avr, AVR_IOCTL_USB_RESET, NULL);
}

static int transaction(bench_t *b, uint32_t what, uint8_t endpoint, uint8_t *bytes, size_t count)
{
    struct avr_io_usb packet = {.pipe = endpoint, .sz = (uint32_t)count, .buf = bytes};
    int result = avr_ioctl(b->avr, what, &packet);
    return result == AVR_IOCTL_USB_OK ? (int)packet.sz : result;
}

int bench_usb_setup(bench_t *b, const uint8_t *request)
{
    return transaction(b, AVR_IOCTL_USB_SETUP, 0, (uint8_t *)request, 8);
}

int bench_usb_out(bench_t *b, uint8_t endpoint, const uint8_t *bytes, size_t count)
{
    return transaction(b, AVR_IOCTL_USB_WRITE, endpoint, (uint8_t *)bytes, count);
}

int bench_usb_in(bench_t *b, uint8_t endpoint, uint8_t *bytes, size_t most)
{
    return transaction(b, AVR_IOCTL_USB_READ, endpoint, bytes, most);
}
