#include "board.h"

extern uint32_t data_source[], data_begin[], data_end[], bss_begin[], bss_end[], heap_begin[];
extern uint32_t stack_end[];
extern int main(void);
void start(void);

/* Operations of "Semihosting for AArch32 and AArch64", Arm IHI 0074. */
enum { OPEN = 0x01, CLOSE = 0x02, WRITE = 0x05, READ = 0x06, EXIT_EXTENDED = 0x20 };

static int semihosting(int operation, const void *arguments) {
    register int code __asm__("r0") = operation;
    register const void *block __asm__("r1") = arguments;
    __asm__ volatile("bkpt 0xab" : "+r"(code) : "r"(block) : "memory");
    return code;
}

static void leave(int code) {
    uint32_t block[2] = {0x20026, (uint32_t)code}; /* ADP_Stopped_ApplicationExit */
    semihosting(EXIT_EXTENDED, block);
    for (;;) {
    }
}

int board_open(const char *name, int write) {
    size_t length = 0;
    while (name[length]) length++;
    uint32_t block[3] = {(uint32_t)name, write ? 5 : 1, length}; /* "wb" or "rb" */
    int file = semihosting(OPEN, block);
    if (file < 0) leave(3);
    return file;
}

size_t board_read(int file, void *into, size_t size) {
    uint32_t block[3] = {(uint32_t)file, (uint32_t)into, size};
    return size - (size_t)semihosting(READ, block);
}

void board_write(int file, const void *from, size_t size) {
    uint32_t block[3] = {(uint32_t)file, (uint32_t)from, size};
    if (semihosting(WRITE, block)) leave(4);
}

void board_close(int file) {
    uint32_t block[1] = {(uint32_t)file};
    semihosting(CLOSE, block);
}

#define SYSTICK ((volatile uint32_t *)0xe000e010) /* control, reload, current value */

void board_timer_start(void) {
    SYSTICK[0] = 0;
    SYSTICK[1] = 0xffffff;
    SYSTICK[2] = 0;
    SYSTICK[0] = 5; /* on, with the clock of the processor */
}

uint32_t board_timer_ticks(void) {
    uint32_t left = SYSTICK[2];
    if (SYSTICK[0] & 0x10000) leave(5); /* it ran over */
    return left ? 0xffffff - left : 0;
}

#define PATTERN 0xa5c3a5c3u

static uint32_t *stack_top;

__attribute__((noinline)) void board_stack_fill(void) {
    stack_top = (uint32_t *)__builtin_frame_address(0) - 4;
    for (uint32_t *word = heap_begin; word < stack_top; word++) *word = PATTERN;
}

size_t board_stack_used(void) {
    uint32_t *word = heap_begin;
    while (word < stack_top && *word == PATTERN) word++;
    return (size_t)((char *)(stack_top + 4) - (char *)word);
}

void start(void) {
    *(volatile uint32_t *)0xe000ed88 |= 0xfu << 20; /* CPACR: the floating point unit */
    __asm__ volatile("dsb\n isb");
    uint32_t *from = data_source;
    for (uint32_t *to = data_begin; to < data_end;) *to++ = *from++;
    for (uint32_t *to = bss_begin; to < bss_end;) *to++ = 0;
    leave(main());
}

static void fault(void) { leave(2); }

__attribute__((section(".vectors"), used)) static void *const vectors[16] = {
    stack_end, (void *)start, (void *)fault, (void *)fault,
    (void *)fault, (void *)fault, (void *)fault};
