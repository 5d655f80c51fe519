# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""vehicle-code: cost of exported C code of effects and networks on an emulated STM32F405.

The emulator counts the instructions per TDOA: mean and maximum over random states. Flash has two
columns: the exported functions and tables alone, and with the functions that they need of the C
library. RAM is stack and state.
"""

from c_programs import ANCHORS, COMMON, chosen, cost_of, effects, missing, network

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import temporary_folder
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_tools.exporting.vehicle import vehicle_code

PATTERNS = "received_power_bias", "antenna_pattern"


def add_options(add):
    """add : add_argument of a parser."""
    add("--each", action="store_true", help="every effect alone, too")


def run(args):
    """Print the table."""
    lacking = missing()
    if lacking:
        raise InputError(f"vehicle-code: needs {', '.join(lacking)}; install them.")
    for line in table(args.each):
        print(line, flush=True)


def table(each=False):
    """Lines of Markdown."""
    yield "| correction | instructions | the most | with Jacobian | flash, B | with libm, B | RAM, B |"
    yield "| --- | ---: | ---: | ---: | ---: | ---: | ---: |"
    with temporary_folder() as folder:
        for name, held, learned in _corrections(folder, each):
            cost = cost_of(folder / "made", vehicle_code(ANCHORS, held, learned))
            both = cost["instructions"] + cost["jacobian"]
            yield (
                f"| {name} | {cost['instructions']:.0f} | {cost['most']:.0f} | {both:.0f} | {cost['own']} | "
                f"{cost['flash']} | {cost['ram']} |"
            )


def _corrections(folder, each):
    yield "ten effects", chosen(*COMMON), None
    for name in PATTERNS:
        yield f"{name}", chosen(name), None
    yield "ten effects and both of these", chosen(*COMMON, *PATTERNS), None
    for inputs, orientations in ((14, True), (8, False)):
        yield f"network of {inputs} inputs", EffectSet(), network(folder, orientations)
    yield "ten effects and the network of 14", chosen(*COMMON), network(folder)
    for name in effects() if each else ():
        yield name, chosen(name), None
