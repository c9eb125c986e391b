"""Planning pushes: where the pusher can go, which pushes to try, MPPI over predicted futures (paper, section 4.4)."""
