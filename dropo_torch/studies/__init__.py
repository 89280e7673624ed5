"""Many fits side by side: sweeps of ε, comparisons of methods, calibration."""
