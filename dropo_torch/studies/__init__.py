"""Many fits side by side: sweeps of ε, comparisons of methods, published studies."""
