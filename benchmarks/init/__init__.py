"""Systems whose truth is known, and logs of them in people's own columns, units and rates."""
