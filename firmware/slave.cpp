#include "slave.h"

#include "boot.h"
#include "buzzer.h"
#include "front.h"
#include "mailbox.h"
#include "motors.h"
#include "reports.h"
#include "ticks.h"

namespace slave {

namespace {

using namespace layout;

constexpr uint8_t LONGEST = 1 + 2 * TUNE_NOTES;
static_assert(LONGEST >= 1 + WINDOW_SIZE, "a page and its window are one write");

uint8_t snapshot[sizeof(Front)];
uint8_t index = 0;           // of the next byte to be read
uint8_t onward = 0;          // where a joined read goes on behind STATUS; 0: it has, or is none
uint8_t mark = 0;            // where the last joined read ended
bool marking = false;        // this read is a joined one, behind STATUS
uint8_t first = 0;           // of the held write
uint8_t held[LONGEST];
uint8_t held_count = 0;
uint8_t room = 0;            // how many bytes fit from `first` on
bool index_next = false;

void freeze()
{
    // Reads only go upward, so what lies before the index is left out. Four bytes a round: 19 cycles, 10 us at most for
    // the longest thing an interrupt does here.
    static_assert(sizeof snapshot % 4 == 0, "copied by fours");
    uint8_t at = index & 0xFC;
    const volatile uint8_t* live = reinterpret_cast<const volatile uint8_t*>(&front) + at;
    uint8_t* to = snapshot + at;
    for (; at < sizeof snapshot; at = static_cast<uint8_t>(at + 4)) {
        *to++ = *live++;
        *to++ = *live++;
        *to++ = *live++;
        *to++ = *live++;
    }
    snapshot[STATUS] |= static_cast<uint8_t>(reports::number() << 4);
}

uint8_t room_at(uint8_t at)
{
    if (at >= LEDS && at <= MOTORS)
        return static_cast<uint8_t>(ENCODERS - at);
    if (at == COMMAND)
        return 2;
    if (at == NOTES)
        return LONGEST;
    if (front.mailbox_state == MailboxState::busy)
        return 0;
    if (at == MAILBOX_TOKEN)
        return 2;
    if (at >= MAILBOX_PAGE && at < MAILBOX_WINDOW + WINDOW_SIZE)
        return static_cast<uint8_t>(MAILBOX_WINDOW + WINDOW_SIZE - at);
    return 0;
}

// Returns false for a write that makes no sense.
bool apply()
{
    if (first < ENCODERS) {
        const uint8_t end = static_cast<uint8_t>(first + held_count);
        // A write that was cut off would make one duty of new and old bytes.
        if (end > MOTORS && end != ENCODERS)
            return false;
        volatile uint8_t* live = reinterpret_cast<volatile uint8_t*>(&front);
        for (uint8_t i = 0; i < held_count; ++i)
            live[first + i] = held[i];
        if (end == ENCODERS)
            motors::written();
        return true;
    }
    if (first == COMMAND)
        return held_count == 2 && boot::command(static_cast<uint16_t>(held[0] | held[1] << 8));
    if (first == NOTES)
        return buzzer::play(held, held_count);
    if (first == MAILBOX_TOKEN)
        return held_count == 2 && mailbox::go(held[0], held[1]);
    return mailbox::write(static_cast<uint8_t>(first - MAILBOX_PAGE), held, held_count);
}

}  // namespace

void started()
{
    index_next = true;
    held_count = 0;
}

bool copies(uint8_t byte)
{
    return index_next && (byte <= sizeof snapshot - 16 || byte >= JOINED);
}

bool received(uint8_t byte)
{
    if (index_next) {
        index_next = false;
        index = first = byte;
        onward = 0;
        marking = false;
        if (byte >= JOINED) {
            index = ENCODERS;
            onward = byte == ONWARD ? mark : static_cast<uint8_t>((byte - JOINED) << 2);
        }
        room = room_at(byte);
        freeze();
        if (byte == UWB || onward == UWB)
            reports::freeze(ticks::now_in_interrupt());
    } else if (held_count < room) {
        held[held_count++] = byte;
    }
    return held_count < room;
}

void stopped()
{
    if (held_count != 0 && !apply())
        front.refused = static_cast<uint8_t>(front.refused + 1);
    held_count = 0;
}

void refused()
{
    held_count = 0;
    front.refused = static_cast<uint8_t>(front.refused + 1);
}

void abandoned()
{
    held_count = 0;
}

uint8_t transmit()
{
    if (onward != 0 && index == STATUS + 1) {
        index = onward;
        onward = 0;
        marking = true;
    }
    const uint8_t at = index;
    if (at != 0xFF)
        ++index;  // offset 255 is not in use: beyond it there are zeros
    if (marking)
        mark = index;
    if (at < sizeof snapshot)
        return snapshot[at];
    if (at < UWB + sizeof(UwbReport))
        return reports::frozen(static_cast<uint8_t>(at - UWB));
    if (at >= MAILBOX_PAGE && at < MAILBOX_WINDOW + WINDOW_SIZE)
        return mailbox::read(static_cast<uint8_t>(at - MAILBOX_PAGE));
    return 0;
}

}  // namespace slave
