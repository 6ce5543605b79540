"""Makes the parity fixtures with the PyTorch package (`pip install './bindings/python[torch]'`): `python tests/parity/make_fixtures.py`.

Everything is computed in float64 and stored as float32. So a fixture is exact to the last bit of a float32, does not
depend on the machine, and tests measure the error of the Rust side. Tensors have PyTorch's names.

- `inputs.safetensors`: one batch, `color_gamma`, `features_z`, `reference_hdr`.
- `VARIANT-READING.safetensors` and, with a kernel head, `demc-READING-kernel.safetensors`: `weight/*`, `output_eval` and, in train mode, `output_train`, `loss`, `grad/*`, and
  `adam/*`: weights and running statistics after 5 steps of Adam on the same batch.
- `unet.safetensors`: the same for the small U-Net of Open Image Denoise.
- `kpcn.safetensors`: inputs, `weight/*`, `output`, and for both losses of KPCN the loss and `grad/*`.
- `blocks.safetensors`: inputs, outputs and gradients of single blocks of `demc-*`, for the loss
  `sum(outputs * probes)`; and the loss function on its own.

A gradient test is meaningful and robust if three conditions hold. Outputs have order 1. No gradient vanishes, except
where it must. No ReLU is so close to its kink that rounding decides. The script checks all three; for the last one, a
float32 run of PyTorch must stay within a fifth of the tolerances of the Rust tests.
"""

from pathlib import Path

import numpy as np
import torch
from safetensors.numpy import save
from torch import Tensor, nn

from demc.torch import Denoiser, Kpcn, ModelConfig, Unet, hdr_from_gamma, rel_mse
from demc.torch.config import READINGS, UNET, VARIANTS
from demc.torch.kpcn import joined_hdr, separate_loss

FIXTURES = Path(__file__).parent / "fixtures"
WIDTH = 2
SHAPE = (2, 64, 64)  # batch, height, width: the latent is 2 x 2, the smallest size that uses every tap of its 3x3 kernels
SEEDS = {  # found by trial, because the checks reject some seeds; 0 where none is named
    "demc-paper-kernel": 2,
    "demc-released-kernel": 2,
    "semc-paper": 1,
    "kpcn": 7,
    "unet": 8,
}
STEPS, LEARNING_RATE = 5, 1e-3
MARGIN = 0.2  # share of the Rust tests' tolerances that float32 rounding may use up
OUTPUT_TOLERANCE = 1e-5  # of the largest value; these three are those of tests/tests/suite/parity/
GRADIENT_TOLERANCE = (2e-5, 1e-4)  # of the tensor's largest value, and of the value itself
ADAM_TOLERANCE = 0.02  # of the path of a weight whose gradient keeps its sign, STEPS * LEARNING_RATE


def main() -> None:
    torch.set_num_threads(1)  # one order of summation
    FIXTURES.mkdir(exist_ok=True)
    batch = draw_batch(np.random.RandomState(0))
    write("inputs", batch)
    blocks = loss_block(np.random.RandomState(2))
    for variant in VARIANTS:
        for reading in READINGS:
            for head in ("grey", "kernel") if variant == "demc" else ("grey",):
                config = ModelConfig(variant, reading, WIDTH, head=head)
                name = f"{variant}-{reading}" + ("-kernel" if head == "kernel" else "")
                weights = write_network(name, config, batch)
                if variant == "demc" and head == "grey":
                    blocks |= blocks_of(config, weights)
    write("blocks", blocks)
    write("kpcn", kpcn(np.random.RandomState(SEEDS["kpcn"])))
    write_network("unet", ModelConfig(UNET, size="small"), batch)


def write_network(name: str, config: ModelConfig, batch: dict[str, Tensor]) -> dict[str, Tensor]:
    """Draws the weights of a network, writes its fixture, and returns the weights."""
    weights = draw_weights(config, batch, np.random.RandomState(SEEDS.get(name, 0)))
    results = run(config, weights, batch, torch.float64)
    check_alive(config, results)
    worst = check_robust(config, results, run(config, weights, batch, torch.float32))
    print(f"{name}: float32 takes at most {worst:.3f} of a tolerance")
    write(name, {f"weight/{key}": value for key, value in weights.items()} | results)
    return weights


def network(config: ModelConfig) -> Denoiser | Unet:
    return Unet(config) if config.variant == UNET else Denoiser(config)


def write(name: str, tensors: dict[str, Tensor]) -> None:
    arrays = {key: np.ascontiguousarray(t.detach().numpy(), np.float32) for key, t in tensors.items()}
    (FIXTURES / f"{name}.safetensors").write_bytes(save(arrays))


def tensor(values: np.ndarray) -> Tensor:
    """Values as float64, rounded to the float32 values of the file."""
    return torch.from_numpy(np.float32(values)).double()


def draw_batch(random: np.random.RandomState) -> dict[str, Tensor]:
    """Random inputs and reference; NumPy guarantees that RandomState never changes."""
    b, h, w = SHAPE
    return {
        "color_gamma": tensor(random.uniform(0, 1.5, (b, 3, h, w))),
        "features_z": tensor(random.randn(b, 12, h, w)),
        "reference_hdr": tensor(random.uniform(0.2, 2, (b, 3, h, w))),
    }


def draw_weights(config: ModelConfig, batch: dict[str, Tensor], random: np.random.RandomState) -> dict[str, Tensor]:
    """Random weights, calibrated by one pass. It shifts and scales each convolution so that every channel of its output
    has a mean near 0.75 and a standard deviation of 0.7. Without it, half of a network of width 2 would be dead."""
    model = network(config).double().eval()
    ranges = {"running_mean": (0.4, 1.0), "running_var": (0.3, 0.8), "weight": (0.5, 0.9), "bias": (0.6, 0.9)}
    for name, value in model.state_dict().items():
        shape, limits = tuple(value.shape), ranges[name.split(".")[-1]]
        value.copy_(tensor(random.randn(*shape) if len(shape) == 4 else random.uniform(*limits, shape)))

    def calibrate(conv: nn.Module, inputs: tuple[Tensor], output: Tensor) -> Tensor:
        channels = 1 if isinstance(conv, nn.ConvTranspose2d) else 0  # axis of the weight
        scale = 0.7 / output.std((0, 2, 3))
        conv.weight.mul_(scale.view([-1 if axis == channels else 1 for axis in range(4)]))
        target = tensor(random.uniform(0.6, 0.9, scale.shape))
        conv.bias.copy_((conv.bias - output.mean((0, 2, 3))) * scale + target)
        return type(conv).forward(conv, *inputs)

    for module in model.modules():
        if isinstance(module, (nn.Conv2d, nn.ConvTranspose2d)):
            module.register_forward_hook(calibrate)
    with torch.no_grad():
        model(batch["color_gamma"], batch["features_z"])
    return {name: tensor(value.numpy()) for name, value in model.state_dict().items()}


def zero_by_construction(config: ModelConfig, name: str) -> bool:
    """Whether this is a bias before a batch normalisation, which cancels the bias with the mean."""
    normed = ("deconv.bias", "latent.conv.bias") if READINGS[config.reading].norm else ()
    return name.endswith(("fusion.blocks.1.conv.bias", "fusion.blocks.2.conv.bias", *normed))


def run(
    config: ModelConfig, weights: dict[str, Tensor], batch: dict[str, Tensor], dtype: torch.dtype
) -> dict[str, Tensor]:
    """The contents of a fixture besides the weights: both outputs, the loss, gradients, and the result of Adam."""
    model = network(config)
    model.load_state_dict(weights, strict=True)
    model.to(dtype)
    color, features, reference = (batch[name].to(dtype) for name in ("color_gamma", "features_z", "reference_hdr"))
    with torch.no_grad():
        result = {"output_eval": model.eval()(color, features)}
    model.train()
    adam = torch.optim.Adam(model.parameters(), lr=LEARNING_RATE, betas=(0.9, 0.999), eps=1e-8)
    for step in range(STEPS):
        output = model(color, features)
        loss = rel_mse(hdr_from_gamma(output), reference)
        adam.zero_grad()
        loss.backward()
        if step == 0:
            result |= {"output_train": output.detach(), "loss": loss.detach().reshape(1)}
            result |= {f"grad/{name}": p.grad.clone() for name, p in model.named_parameters()}
        adam.step()
    return result | {f"adam/{name}": value.clone() for name, value in model.state_dict().items()}


def check_alive(config: ModelConfig, results: dict[str, Tensor]) -> None:
    """Fails if outputs are far from order 1, or if a gradient nearly vanishes that should not."""
    for name, value in results.items():
        zeros, largest = (value == 0).double().mean(), value.abs().max()
        if name.startswith("output"):
            good = 0.3 < value.mean() < 2 and largest < 10 and zeros < 0.3
        elif name.startswith("grad/") and not zero_by_construction(config, name):
            # A kernel head averages, so its gradients are smaller.
            good = largest > (1e-3 if config.head == "grey" else 1e-4) and zeros < 0.3
        else:
            continue
        if not good:
            raise RuntimeError(f"{config}: {name}: largest {largest:.1e}, {zeros:.0%} zeros")


def check_robust(config: ModelConfig, results: dict[str, Tensor], single: dict[str, Tensor]) -> float:
    """The largest share of a tolerance that float32 rounding takes; fails if it exceeds MARGIN."""
    shares = {}
    for name, expected in results.items():
        if zero_by_construction(config, name) or name.endswith("running_mean"):
            continue  # Adam moves such a bias at random, and the running mean follows
        scale = expected.abs()
        if name.startswith("grad/"):
            tolerance = GRADIENT_TOLERANCE[0] * scale.max() + GRADIENT_TOLERANCE[1] * scale
        elif name.startswith("adam/"):
            tolerance = torch.tensor(ADAM_TOLERANCE * STEPS * LEARNING_RATE)
        else:
            tolerance = OUTPUT_TOLERANCE * scale.max()
        shares[name] = ((single[name].double() - expected).abs() / tolerance).max().item()
    name = max(shares, key=shares.get)
    if shares[name] > MARGIN:
        raise RuntimeError(f"{config}: {name}: float32 takes {shares[name]:.2f} of the tolerance")
    return shares[name]


def blocks_of(config: ModelConfig, weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """The blocks of a network by their paths, each with its own inputs."""
    random = np.random.RandomState(1)
    k = WIDTH

    def normal(channels: int, height: int, width: int) -> Tensor:
        return tensor(random.randn(2, channels, height, width))

    cases = {
        "fusion": [normal(12, 8, 16)],
        "encoders.0.levels.4": [normal(8 * k, 4, 6)],  # the one that stops at its skip in the paper's reading
        "encoders.1.levels.1": [normal(k, 8, 12)],
        "latent": [normal(8 * k, 4, 6)],
        "decoder.levels.3": [normal(4 * k, 4, 6), normal(2 * k, 8, 12), normal(2 * k, 8, 12)],
        "decoder.head": [normal(k, 8, 12)],
    }
    tensors = {}
    for path, inputs in cases.items():
        model = Denoiser(config).double()
        model.load_state_dict(weights, strict=True)
        block = model.get_submodule(path)
        forward = (lambda x, *skips: block(x, skips)) if path.startswith("decoder.levels") else block
        case = {f"input.{i}": x for i, x in enumerate(inputs)}
        with torch.no_grad():
            block.eval()
            case |= {f"eval.{i}": y for i, y in enumerate(outputs_of(forward, inputs))}
            block.train()
        outputs = outputs_of(forward, [x.requires_grad_() for x in inputs])
        probes = [tensor(random.uniform(0.5, 1.5, tuple(y.shape))) for y in outputs]
        sum((y * probe).sum() for y, probe in zip(outputs, probes)).backward()
        case |= {f"train.{i}": y for i, y in enumerate(outputs)} | {f"probe.{i}": p for i, p in enumerate(probes)}
        case |= {f"input_grad.{i}": x.grad for i, x in enumerate(inputs)}
        case |= {f"grad.{name}": p.grad for name, p in block.named_parameters()}
        case |= {f"after.{name}": b for name, b in block.named_buffers()}
        tensors |= {f"{config.reading}/{path}/{name}": value for name, value in case.items()}
    return tensors


def outputs_of(forward, inputs: list[Tensor]) -> list[Tensor]:
    outputs = forward(*inputs)
    return [y for y in outputs if y is not None] if isinstance(outputs, tuple) else [outputs]


def loss_block(random: np.random.RandomState) -> dict[str, Tensor]:
    """RelMSE after `hdr_from_gamma`, with outputs at 0, where x^2.2 has gradient 0, and black reference pixels."""
    output = tensor(random.uniform(0, 1.5, (2, 3, 8, 12)))
    output[:, :, ::4, ::4] = 0
    reference = tensor(random.uniform(0.2, 2, (2, 3, 8, 12)))
    reference[:, :, 2::4, 2::4] = 0
    loss = rel_mse(hdr_from_gamma(output.requires_grad_()), reference)
    loss.backward()
    return {
        "loss/output_gamma": output,
        "loss/reference_hdr": reference,
        "loss/loss": loss.reshape(1),
        "loss/grad": output.grad,
    }


def kpcn(random: np.random.RandomState) -> dict[str, Tensor]:
    """The networks of KPCN, with weights above Xavier's, so that kernels differ from each other."""
    b, h, w = 2, 32, 32
    batch = {
        "light": tensor(random.uniform(0, 1.5, (b, 6, h, w))),
        "features": tensor(random.uniform(0, 1.0, (b, 12, h, w))),
        "divisor": tensor(random.uniform(0.1, 1.0, (b, 3, h, w))),
        "reference_light": tensor(random.uniform(0, 1.5, (b, 6, h, w))),
        "reference_hdr": tensor(random.uniform(0.2, 2, (b, 3, h, w))),
    }
    config = ModelConfig("kpcn", width=WIDTH)
    shapes = {name: tuple(value.shape) for name, value in Kpcn(config).state_dict().items()}
    weights = {
        name: tensor(random.uniform(-1, 1, shape) * (0.02 if len(shape) == 1 else 2.4 / np.sqrt(shape[1] * 25)))
        for name, shape in shapes.items()
    }

    def results(dtype: torch.dtype) -> dict[str, Tensor]:
        model = Kpcn(config)
        model.load_state_dict(weights, strict=True)
        model.to(dtype)
        light, features, divisor, reference_light, reference_hdr = (value.to(dtype) for value in batch.values())
        found = {}
        for name in ("separate", "joined"):
            output = model(light, features)
            joined = (joined_hdr(output, divisor) - reference_hdr).abs().mean()
            loss = separate_loss(output, reference_light) if name == "separate" else joined
            model.zero_grad()
            loss.backward()
            found |= {"output": output.detach(), f"{name}/loss": loss.detach().reshape(1)}
            found |= {f"{name}/grad/{key}": p.grad.clone() for key, p in model.named_parameters()}
        return found

    exact = results(torch.float64)
    for name, value in exact.items():
        if "/grad/" in name and not (value.abs().max() > 1e-7 and (value == 0).double().mean() < 0.5):
            raise RuntimeError(f"kpcn: {name}: largest {value.abs().max():.1e}")
    shares = {}
    for name, single in results(torch.float32).items():
        scale = exact[name].abs()
        relative = GRADIENT_TOLERANCE if "/grad/" in name else (OUTPUT_TOLERANCE, 0)
        tolerance = relative[0] * scale.max() + relative[1] * scale
        shares[name] = ((single.double() - exact[name]).abs() / tolerance).max().item()
    name = max(shares, key=shares.get)
    print(f"kpcn: float32 takes {shares[name]:.3f} of a tolerance, in {name}")
    if shares[name] > MARGIN:
        raise RuntimeError(f"kpcn: {name}: float32 takes {shares[name]:.2f} of the tolerance")
    return batch | {f"weight/{key}": value for key, value in weights.items()} | exact


if __name__ == "__main__":
    main()
