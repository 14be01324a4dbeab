#include "uart.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <util/atomic.h>

namespace uart {

namespace {

constexpr uint8_t RING = 64;  // 5.5 ms of bytes
static_assert((RING & (RING - 1)) == 0, "indices wrap by a mask");

volatile uint8_t ring[RING];
volatile uint8_t head = 0;  // written by the interrupt
volatile uint8_t tail = 0;  // written by the main loop
volatile bool lost = false;

const uint8_t* volatile to_send = nullptr;
volatile uint16_t left = 0;

}  // namespace

void start()
{
    // Datasheet 18, Examples of Baud Rate Setting: 115200 baud from 16 MHz. U2X with 16 is 2.1 % fast, normal mode's
    // 8 would be 3.5 % slow.
    UCSR1A = _BV(U2X1);  // before UBRR1: simavr works out its speed when that is written
    UBRR1 = 16;
    UCSR1C = _BV(UCSZ11) | _BV(UCSZ10);
    UCSR1B = _BV(RXEN1) | _BV(TXEN1) | _BV(RXCIE1);
}

void send(const uint8_t* bytes, uint16_t count)
{
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        to_send = bytes;
        left = count;
        UCSR1B |= _BV(UDRIE1);
    }
}

bool sending()
{
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        return left != 0;
    }
    __builtin_unreachable();
}

bool take(uint8_t& byte)
{
    const uint8_t at = tail;
    if (at == head)
        return false;
    byte = ring[at];
    tail = (at + 1) & (RING - 1);
    return true;
}

bool damaged()
{
    // A byte lost between the two lines belongs to the same breakage.
    const bool result = lost;
    if (result)
        lost = false;
    return result;
}

}  // namespace uart

ISR(USART1_RX_vect)
{
    using namespace uart;
    const uint8_t errors = UCSR1A & (_BV(FE1) | _BV(DOR1));  // before UDR1: reading it moves on (datasheet 18)
    const uint8_t byte = UDR1;
    const uint8_t next = (head + 1) & (RING - 1);
    if (errors != 0 || next == tail) {
        lost = true;
        return;
    }
    ring[head] = byte;
    head = next;
}

// The bytes of a request follow each other without a gap: the module gives up after 25/32768 s (API guide, UART).
ISR(USART1_UDRE_vect)
{
    using namespace uart;
    const uint8_t* next = to_send;
    UDR1 = *next;
    to_send = next + 1;
    const uint16_t more = left - 1;
    left = more;
    if (more == 0)
        UCSR1B &= static_cast<uint8_t>(~_BV(UDRIE1));
}
