"""What the mains of all executables share: the look of --help, and how a failure is told and counted.

    def main(argv=None):
        parser = cli.parser("convert", "Convert a log to a bag.", "convert flight.log --survey s.txt --out flight.bag")
        parser.add_argument("log")
        return cli.run(convert, parser, argv)          # convert(args) -> exit code, None for 0
"""

import argparse
import os
import sys

from uwb_tdoa_bias.foundation.errors import InputError


def parser(name, description, *examples):
    """An ArgumentParser that keeps line breaks, and ends its help with the given example command lines."""
    epilog = "examples:\n" + "\n".join(f"  {example}" for example in examples) if examples else None
    return argparse.ArgumentParser(
        prog=name, description=description, epilog=epilog, formatter_class=argparse.RawDescriptionHelpFormatter
    )


def run(command, parser, argv=None):
    """Parse argv (default: sys.argv[1:]), call command(args), and return the exit code of the process.

    0 or what command returned; 2 for bad usage, an InputError or a file that cannot be used, each told in one sentence
    on stderr; 130 after Ctrl-C; 141 when whoever read our output has gone.
    """
    try:
        code = command(parser.parse_args(argv)) or 0
        sys.stdout.flush()
        return code
    except SystemExit as stop:  # argparse has said it already: usage and error, or the help
        return stop.code or 0
    except InputError as error:
        return _fail(parser.prog, error)
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or the flush at exit fails once more
        return 141
    except OSError as error:
        if error.filename is None:
            raise
        return _fail(parser.prog, f"{error.filename}: {error.strerror}.")


def _fail(name, sentence):
    print(f"{name}: error: {sentence}", file=sys.stderr)
    return 2
