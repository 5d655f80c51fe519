"""Faults put into a flight that real nodes hear over topics: `events` is what is sent, `faults` changes it, `play` sends it, `judge` compares
what the nodes publish with ground truth."""
