"""Options that several commands share, and what they ask for.

    options.add_recordings(parser)                  # FLIGHT..., --survey, --namespace
    options.add_filter(parser)                      # --effects, --config
    config, effects = options.filter_of(args)
"""

from dataclasses import fields, replace

from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.safe_yaml import parse_yaml
from uwb_tdoa_ekf.core.config import RENAMED, FilterConfig, current_names

from .readers import inputs


def add_recordings(parser, nargs="+"):
    """FLIGHT..., and how to read them."""
    parser.add_argument("flights", nargs=nargs, metavar="FLIGHT", help=inputs.HELP)
    add_survey(parser)
    add_namespace(parser)


def add_survey(parser):
    """--survey."""
    parser.add_argument("--survey", metavar="S", help=inputs.SURVEY_HELP)


def add_namespace(parser):
    """--namespace."""
    parser.add_argument("--namespace", default="", help="of the topics in the bags, e.g. tag1")


def add_filter(parser, effects="effects.yaml to correct the TDOAs with, before the filter"):
    """--effects and --config. effects : help of the first."""
    parser.add_argument("--effects", metavar="FILE", help=effects)
    parser.add_argument("--config", metavar="FILE", help="filter parameters, as for ekf_node (ekf_node.yaml)")


def filter_of(args):
    """(FilterConfig, EffectSet or None) that --config and --effects name. Raises InputError."""
    config = FilterConfig.from_yaml(args.config) if args.config else FilterConfig()
    return config, EffectSet.from_yaml(args.effects) if args.effects else None


def with_parameters(config, texts):
    """A FilterConfig with the values of texts "name:=value". Raises InputError."""
    return replace(config, **current_names(dict(map(_parameter, texts))))


def _parameter(text):
    """(name, value) of "name:=value"."""
    name, assigned, value = text.partition(":=")
    names = [field.name for field in fields(FilterConfig)]
    if not assigned or name not in (*names, *RENAMED):
        raise InputError(f"-p {text}: write NAME:=VALUE, where NAME is one of {', '.join(names)}.")
    return name, parse_yaml(value, f"-p {text}")
