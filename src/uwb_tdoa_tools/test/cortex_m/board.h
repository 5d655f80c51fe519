/* What the test program needs of a computer: board.c for a Cortex-M4 in qemu, host.c for others. */
#ifndef BOARD_H
#define BOARD_H
#include <stddef.h>
#include <stdint.h>

/* Open a file of the host, to read it or to write it. */
int board_open(const char *name, int write);
/* Read up to `size` bytes; return how many there were. */
size_t board_read(int file, void *into, size_t size);
void board_write(int file, const void *from, size_t size);
void board_close(int file);

/* Start the timer. */
void board_timer_start(void);
/* Return its ticks since then, at most 2^24; 0 on a computer without it. */
uint32_t board_timer_ticks(void);

/* Fill the free stack with a pattern. */
void board_stack_fill(void);
/* Return how many bytes of it were used since then; 0 on a computer without it. */
size_t board_stack_used(void);
#endif
