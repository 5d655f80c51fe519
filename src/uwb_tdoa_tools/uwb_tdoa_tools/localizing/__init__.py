"""Where the tag was: recordings to trajectories, without ground truth."""
