"""What REST, viewer and jobs have in common: one service for each noun."""
