"""torch-kf: filtering of all series at once, in single precision."""

import torch
from torch_batches import filtered, run

if __name__ == "__main__":
    run(filtered, torch.float32)
