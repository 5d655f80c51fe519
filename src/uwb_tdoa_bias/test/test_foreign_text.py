import pytest

from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.common.text import printable, sanitize

ATTACK = "\x1b[2J\x1b]0;title\x07\r\nok \u202efdp.exe \ud800 \x9b31m"


def test_a_terminal_shows_what_would_steer_it():
    shown = printable(ATTACK)
    assert shown.isprintable() and shown.startswith(
        r"\x1b[2J\x1b]0;title\x07\r\nok \u202efdp.exe \ud800 \x9b31m"
    )
    assert printable("Größe, 3 m²: 'a' | $x$") == "Größe, 3 m²: 'a' | $x$"


@pytest.mark.parametrize(
    ("name", "left"),
    [
        ("0425-traj1", "0425-traj1"),
        ("Halle 3 (Süd), 2.5 m", "Halle 3 (Süd), 2.5 m"),
        ("physics+structured", "physics+structured"),
        ("$\\frac$", "__frac_"),
        ("<img src=x onerror=alert(1)>", "_img src=x onerror=alert(1)_"),
        ("a|b\n# c", "a_b_# c"),
        ("../../etc/passwd", ".._.._etc_passwd"),
        ("[x](javascript:y)", "_x_(javascript:y)"),
        ("`id` && $(id)", "_id_ __ _(id)"),
        ("x" * 999, "x" * 100),
    ],
)
def test_a_name_means_nothing_anywhere(name, left):
    assert sanitize(name) == left and sanitize(left) == left
    assert Flight(name, None, None).name == left
