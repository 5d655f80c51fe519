"""The filter run over a flight, and judged."""

from dataclasses import replace

from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_bias.effects.tag_lever_arm import TagLeverArm
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_ekf.offline import run_offline

from .metrics import Score


def evaluate(flight, config=None, effects=None, network=None, engine=run_offline):
    """Run the filter over a Flight with ground truth. Returns (Score, Run). Raises InputError if there is no truth.

    engine : run_offline, or smooth, which uses what came after each estimate too."""
    need_truth(flight)
    result = engine(flight, config, Corrector(flight.anchors, with_antenna(effects, flight), network))
    return Score(flight.name, result.odometry, judging_truth(flight, effects), result.residuals, flight.tdoa.t), result


def with_antenna(effects, flight):
    """An EffectSet, or None, and the lever arm of the antenna that the recording of a Flight has told, unless it holds one."""
    arm, known = flight.meta.get("antenna"), effects.effects if effects else ()
    if not arm or not any(arm) or any(effect.name == TagLeverArm.name for effect in known):
        return effects
    return EffectSet((*known, TagLeverArm(values=dict(zip("xyz", arm)))))


def judging_truth(flight, effects=None):
    """The Truth to compare estimates with: that of the Flight, without what the EffectSet says is wrong with it."""
    return effects.correct_streams(replace(flight, imu=None)).truth if effects else flight.truth


def need_truth(flight):
    """Raise InputError if the Flight has no ground truth."""
    if flight.truth is None:
        raise InputError(f"{flight.name}: it holds no ground truth to compare with.")
