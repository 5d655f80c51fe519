/* Run the exported functions over the cases of a file, and measure them. */
#include "board.h"
#include "uwb_bias.h"

typedef struct {
    int32_t a, b;
    uwb_bias_state state;
} test_case;

typedef struct {
    int32_t wrong;
    float bias, std;
} test_result;

typedef struct {
    uint32_t ticks, most, stack, cases; /* of uwb_bias, bytes */
} test_cost;

enum { BLOCK = 32 };

static test_case cases[BLOCK];
static test_result results[BLOCK];

int main(void) {
    test_cost cost = {0, 0, 0, 0};
    const int from = board_open("cases.bin", 0), to = board_open("results.bin", 1);
    size_t n;
    while ((n = board_read(from, cases, sizeof cases) / sizeof *cases) > 0) {
        board_stack_fill();
        for (size_t k = 0; k < n; k++) {
            test_result *one = &results[k];
            board_timer_start();
            one->wrong =
                uwb_bias(cases[k].a, cases[k].b, &cases[k].state, &one->bias, &one->std);
            const uint32_t ticks = board_timer_ticks();
            cost.ticks += ticks;
            if (ticks > cost.most) cost.most = ticks;
        }
        if (board_stack_used() > cost.stack) cost.stack = (uint32_t)board_stack_used();
        cost.cases += (uint32_t)n;
        board_write(to, results, n * sizeof *results);
    }
    board_close(from);
    board_close(to);
    const int of_cost = board_open("cost.bin", 1);
    board_write(of_cost, &cost, sizeof cost);
    board_close(of_cost);
    return 0;
}
