"""What is measured, one file a benchmark; each gives rows of ours beside a rival, taken in one run."""
