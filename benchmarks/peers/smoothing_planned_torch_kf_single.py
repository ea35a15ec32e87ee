"""torch-kf: smoothing of all series at once, in single precision."""

import torch
from torch_batches import run, smoothed

if __name__ == "__main__":
    run(smoothed, torch.float32)
