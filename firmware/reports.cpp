#include "reports.h"

namespace reports {

namespace {

struct Slot {
    layout::UwbReport report;
    uint32_t came;  // ms
};

Slot slots[3];
volatile uint8_t newest = 0;
volatile uint8_t held = 0;
uint8_t filling = 1;

// Neither the newest nor the frozen one. An interrupt between the two reads can only set `held` to `newest`.
uint8_t spare()
{
    const uint8_t a = newest;
    const uint8_t b = held;
    return a != 0 && b != 0 ? 0 : a != 1 && b != 1 ? 1 : 2;
}

}  // namespace

layout::UwbReport& next()
{
    filling = spare();
    return slots[filling].report;
}

void publish(uint32_t now)
{
    Slot& slot = slots[filling];
    uint16_t sequence = static_cast<uint16_t>(slots[newest].report.sequence + 1);
    if (sequence == 0)
        sequence = 1;
    slot.report.sequence = slot.report.sequence_again = sequence;
    slot.report.age = 0;
    slot.came = now;
    asm volatile("" ::: "memory");  // all of it is in memory before the interrupt may see it
    newest = filling;
}

void freeze(uint32_t now)
{
    const uint8_t which = newest;
    held = which;
    Slot& slot = slots[which];
    const uint32_t age = now - slot.came;
    slot.report.age = age > 0xFFFF || slot.report.sequence == 0 ? 0xFFFF : static_cast<uint16_t>(age);
}

uint8_t number()
{
    return static_cast<uint8_t>(slots[newest].report.sequence);
}

uint8_t frozen(uint8_t offset)
{
    return reinterpret_cast<const uint8_t*>(&slots[held].report)[offset];
}

}  // namespace reports
