"""What every room stands on: arrays, counter-based points, files, errors, LLVM. Knows nothing of light."""
