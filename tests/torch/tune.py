"""Trains a bundle for one step and saves its weights with PyTorch: `BUNDLE COLOR FEATURES SIDE WEIGHTS OUTPUT`.

COLOR, FEATURES and OUTPUT are raw float32 of a square image; OUTPUT is the result of the trained network.
"""

import sys

import demc.torch
import numpy as np
import torch
from safetensors.torch import save_file

path, color, features, side, weights, output = sys.argv[1:]
color, features = (np.fromfile(name, "<f4").reshape(-1, int(side), int(side)) for name in (color, features))
bundle = demc.torch.load(path)
before = {name: weight.clone() for name, weight in bundle.model.state_dict().items()}

model = bundle.model.train()
adam = torch.optim.Adam(model.parameters(), lr=1e-2)
hdr, raw = (torch.from_numpy(image)[None] for image in (color, features))
modulation = bundle.modulation(raw)
out = model(demc.torch.gamma_from_hdr(hdr, bundle.gamma) / modulation, bundle.features_z_from_raw(raw)) * modulation
demc.torch.rel_mse(demc.torch.hdr_from_gamma(out, bundle.gamma), torch.full_like(hdr, 0.2)).backward()
adam.step()
model.eval()

changed = [name for name, weight in model.state_dict().items() if not torch.equal(weight, before[name])]
assert any(name.endswith("running_var") for name in changed) and len(changed) > len(before) / 2, changed
save_file(model.state_dict(), weights)
bundle.denoise(color, features).astype("<f4").tofile(output)
