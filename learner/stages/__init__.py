"""The stages of training: prior, AAP, AIP, the oracle and the baselines."""
