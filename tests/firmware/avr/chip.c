/* SPDX-License-Identifier: GPL-3.0-or-later
 * The chip's life: loading, running, resets, memory, and how long interrupts are off. */
#include "internal.h"

#include <simavr/avr_extint.h>
#include <simavr/avr_flash.h>
#include <simavr/sim_elf.h>

#include <stdlib.h>
#include <string.h>

#define R_MCUSR 0x54
#define R_MCUCR 0x55
#define IVSEL 2            /* in MCUCR: interrupt vectors are those of the bootloader */
#define BOOT_SECTION 0x7000

static void quiet(avr_t *avr, const int level, const char *format, va_list list)
{
    (void)avr, (void)level, (void)format, (void)list;
}

/* simavr's own would really sleep, to run in real time. */
static void no_sleep(avr_t *avr, avr_cycle_count_t cycles)
{
    (void)avr, (void)cycles;
}

/* simavr 1.6 has 0x00FF where no word was filled in for a page: an erased word is 0xFFFF. */
static void on_page_write(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param)
{
    avr_flash_t *flash = param;
    (void)address;
    if (value & (1 << flash->pgwrt.bit))
        for (int i = 0; i < flash->spm_pagesize / 2; i++)
            if (!flash->tmppage_used[i])
                flash->tmppage[i] = 0xFFFF;
    avr->data[flash->r_spm] = value;
}

static void flash_attach(avr_t *avr)
{
    for (avr_io_t *io = avr->io_port; io; io = io->next)
        if (!strcmp(io->kind, "flash"))
            avr_register_io_write(avr, ((avr_flash_t *)io)->r_spm, on_page_write, io);
}

/* Called in the middle of avr_reset, which goes on to set things to zero: the rest is done by settle(). */
static void on_reset(avr_io_t *io)
{
    bench_t *b = (bench_t *)((char *)io - offsetof(bench_t, module));
    b->was_reset = 1;
}

static void settle(bench_t *b)
{
    avr_t *avr = b->avr;
    b->was_reset = 0;
    /* simavr may or may not set its clock back on a reset: ours goes on. */
    if (avr->cycle < b->before_reset)
        b->epoch += b->before_reset - avr->cycle;
    if (!b->own_reset) {
        b->resets++;
        b->reset_at = bench_now(b);
        b->reset_flags = avr->data[R_MCUSR];
    }
    b->off = 1;
    b->slept = 0;
    /* INTn is "level low" after a reset, and simavr would raise it again and again, even after the firmware chose
     * edges. */
    for (int i = 0; i < 7; i++)
        avr_extint_set_strict_lvl_trig(avr, (uint8_t)i, 0);
    twi_reset(b);
    uart_reset(b);
    encoders_reset(b);
    board_reset(b);
}

bench_t *bench_new(const char *elf, uint8_t mcusr)
{
    elf_firmware_t firmware;
    memset(&firmware, 0, sizeof firmware);
    avr_global_logger_set(quiet);
    if (elf_read_firmware(elf, &firmware))
        return NULL;
    bench_t *b = calloc(1, sizeof *b);
    avr_t *avr = b->avr = avr_make_mcu_by_name("atmega32u4");
    avr_init(avr);
    firmware.frequency = 16000000;
    firmware.vcc = firmware.avcc = firmware.aref = 5000;
    avr_load_firmware(avr, &firmware);
    avr->frequency = 16000000;
    avr->vcc = avr->avcc = avr->aref = 5000;
    avr->sleep = no_sleep;
    avr->log = LOG_NONE;
    /* Power-up leaves chance in RAM. */
    unsigned chance = 12345;
    for (unsigned i = 0x100; i <= avr->ramend; i++)
        avr->data[i] = (uint8_t)((chance = chance * 1103515245 + 12345) >> 16);
    b->module.kind = "bench";
    b->module.reset = on_reset;
    avr_register_io(avr, &b->module);
    twi_attach(b);
    uart_attach(b);
    board_attach(b);
    encoders_attach(b);
    flash_attach(avr);
    b->own_reset = 1;
    settle(b);
    b->own_reset = 0;
    avr->data[R_MCUSR] = mcusr;
    return b;
}

void bench_free(bench_t *b)
{
    avr_terminate(b->avr);
    free(b->avr->flash);
    free(b->avr->data);
    free(b->avr);
    free(b);
}

uint64_t bench_now(const bench_t *b)
{
    return b->epoch + b->avr->cycle;
}

void bench_reset(bench_t *b, uint8_t mcusr)
{
    b->before_reset = b->avr->cycle;
    b->own_reset = 1;
    avr_reset(b->avr);
    settle(b);
    b->own_reset = 0;
    b->avr->data[R_MCUSR] = mcusr;
}

static void watch(bench_t *b)
{
    int off = !b->avr->sreg[S_I];
    if (b->avr->state == cpu_Sleeping)
        b->slept = 1;
    if (off == b->off)
        return;
    b->off = off;
    if (off)
        b->off_since = b->avr->cycle;
    else if (b->slept && b->avr->cycle - b->off_since > b->off_longest)
        b->off_longest = (uint32_t)(b->avr->cycle - b->off_since);
}

int bench_step(bench_t *b)
{
    avr_t *avr = b->avr;
    b->before_reset = avr->cycle;
    if (b->exact)
        avr->run_cycle_count = 1;
    int state = avr_run(avr);
    if (b->was_reset)
        settle(b);
    /* simavr has interrupt vectors at 0 only. A bootloader that wants its own goes nowhere else below itself. */
    if (avr->data[R_MCUCR] & IVSEL && avr->pc < BOOT_SECTION)
        avr->pc += BOOT_SECTION;
    watch(b);
    return state == cpu_Done || state == cpu_Crashed ? -1 : 0;
}

static avr_cycle_count_t wake(avr_t *avr, avr_cycle_count_t when, void *param)
{
    (void)avr, (void)when, (void)param;
    return 0;
}

int bench_run_to(bench_t *b, uint64_t cycle)
{
    /* A sleeping CPU jumps to the next event: make the end one. Two calls may come from nested loops. */
    while (bench_now(b) < cycle) {
        avr_cycle_timer_register(b->avr, cycle - bench_now(b), wake, b);
        uint64_t epoch = b->epoch;
        while (bench_now(b) < cycle && b->epoch == epoch)
            if (bench_step(b))
                return -1;
    }
    return 0;
}

uint32_t bench_resets(const bench_t *b) { return b->resets; }
uint64_t bench_reset_at(const bench_t *b) { return b->reset_at; }
uint8_t bench_reset_flags(const bench_t *b) { return b->reset_flags; }
uint8_t bench_data(const bench_t *b, uint16_t address) { return b->avr->data[address]; }
void bench_poke(bench_t *b, uint16_t address, uint8_t value) { b->avr->data[address] = value; }
uint32_t bench_pc(const bench_t *b) { return b->avr->pc; }
int bench_asleep(const bench_t *b) { return b->avr->state == cpu_Sleeping; }

uint16_t bench_flash(const bench_t *b, uint32_t address)
{
    return (uint16_t)(b->avr->flash[address] | b->avr->flash[address + 1] << 8);
}

void bench_set_flash(bench_t *b, uint32_t address, uint16_t word)
{
    b->avr->flash[address] = (uint8_t)word;
    b->avr->flash[address + 1] = (uint8_t)(word >> 8);
    if (address + 2 > b->avr->codeend)
        b->avr->codeend = address + 2;
}

void bench_boot_at(bench_t *b, uint32_t address)
{
    b->avr->reset_pc = address;
}

int bench_to_main(bench_t *b)
{
    int exact = b->exact;
    b->exact = 1;
    for (long steps = 0; steps < 10000000; steps++) {
        if (bench_step(b))
            return -1;
        if (b->slept && b->avr->state == cpu_Running && b->avr->sreg[S_I] && b->avr->interrupts.running_ptr == 0) {
            b->exact = exact;
            return (int)b->avr->pc;
        }
    }
    return -1;
}

void bench_watch(bench_t *b, int exact)
{
    b->exact = exact;
    b->off_longest = 0;
}

uint32_t bench_interrupts_off(bench_t *b)
{
    uint32_t longest = b->off_longest;
    b->off_longest = 0;
    return longest;
}
