"""Real photographs: camera response, board, masks, appearance under an unknown lamp, poses."""
