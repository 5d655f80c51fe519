"""What a diagnosis says."""

from dataclasses import dataclass, field


@dataclass
class Finding:
    """effect : Effect with values and std; channel; evidence : {figure: number}; variance_explained : share of the
    channel's variance on held-out rows; candidate : the Candidate it was, None for noise; rivals : [(gap,
    Candidate)]."""

    effect: object
    channel: str
    evidence: dict
    variance_explained: float
    candidate: object = None
    rivals: list = field(default_factory=list)


@dataclass
class Attribution:
    """findings : [Finding], declared; terms : [Finding], undeclared; found : FlightResiduals under the base model;
    left : under the whole model; table, selection : of the last fit; refused : [(name, reason)]; candidates : all
    declared."""

    findings: list
    terms: list
    found: list
    left: list
    table: object
    selection: object
    refused: list
    candidates: list

    @property
    def effects(self):
        """All Effects found."""
        return tuple(f.effect for f in self.findings + self.terms)
