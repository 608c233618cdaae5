"""What a log says about parameters as a distribution: priors, sampling with real replays, checks, export."""
