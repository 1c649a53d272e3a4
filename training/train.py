"""Train a profile.

    python -m training.train base --photographs DIR --edgepoint2 CHECKOUT --alike CHECKOUT
        --corpus DIR --out DIR [--steps N] [--seed N] [--grow-from CHECKPOINT] [--device cuda]

The corpus is made first, where it is not yet complete. Interrupted, the same command goes on from
the last checkpoint. The same seed gives the same batches in the same order.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import torch
from torch import nn

from training.corpus import collect_taught, make_corpus
from training.curve import draw_curve
from training.losses import WEIGHTS, Losses, Projection
from training.network import PROFILES, Network, grow
from training.optimizer import Muon
from training.pairs import Pairs
from training.precision import autocast
from training.standardize import standardize
from training.teachers import Teachers
from training.validation import Validation

WARM_UP_STEPS = 100
LAST_RATE = 0.02  # of the highest
OTHERS_RATE = 2e-3  # of what is no convolution's weight
LOG_EVERY, CHECKPOINT_EVERY, VALIDATE_EVERY = 50, 250, 500


def main(argv: Sequence[str] | None = None) -> None:
    """Train as the command line says."""
    arguments = parse(argv)
    torch.set_num_threads(arguments.threads)
    cv2.setNumThreads(arguments.threads)
    torch.manual_seed(arguments.seed)
    device = torch.device(arguments.device)
    if not (arguments.corpus / "complete").exists():
        teachers = Teachers(arguments.edgepoint2, arguments.alike, device)
        make_corpus(arguments.corpus, arguments.photographs, teachers, seed=0)
    network = Network(PROFILES[arguments.profile])
    losses = Losses(Projection(torch.from_numpy(collect_taught(arguments.corpus))))
    if arguments.grow_from:
        grow(network, torch.load(arguments.grow_from, "cpu")["network"])
    network.to(device, memory_format=torch.channels_last)
    losses.to(device)
    optimizers = make_optimizers(network, losses, arguments.rate)
    arguments.out.mkdir(parents=True, exist_ok=True)
    checkpoint = arguments.out / "checkpoint.pt"
    start = 0
    if checkpoint.exists():
        state = torch.load(checkpoint, device)
        if state["profile"] != dataclasses.asdict(PROFILES[arguments.profile]):
            raise SystemExit(f"{checkpoint} is of another profile; name another folder with --out")
        network.load_state_dict(state["network"])
        losses.load_state_dict(state["losses"])
        for optimizer, kept in zip(optimizers, state["optimizers"], strict=True):
            optimizer.load_state_dict(kept)
        start = state["step"]
    batches = loader(Pairs(arguments.corpus, arguments.pairs, arguments.seed), start, arguments)
    validation = Validation(arguments.photographs, device)
    log = arguments.out / "log.jsonl"
    keep_log(log, start)
    sums: dict[str, float] = {}
    for step, batch in enumerate(batches, start + 1):
        set_rates(optimizers, step, arguments.steps)
        batch = batch.to(device)
        with autocast(device):
            scores, descriptors = network(standardize(batch.images.float()))
        parts = losses(scores, descriptors, batch)
        loss = sum(weight * parts[name] for name, weight in WEIGHTS.items())
        network.zero_grad()
        losses.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 5.0)
        for optimizer in optimizers:
            optimizer.step()
        for name, value in parts.items():
            sums[name] = sums.get(name, 0.0) + value.item() / LOG_EVERY
        if step % LOG_EVERY == 0:
            record = {"step": step} | {name: round(v, 5) for name, v in sums.items()}
            if step % VALIDATE_EVERY == 0 or step == arguments.steps:
                record |= validation.measure(network)
            with log.open("a") as file:
                file.write(json.dumps(record) + "\n")
            sums.clear()
        if step % CHECKPOINT_EVERY == 0 or step == arguments.steps:
            state = {
                "profile": dataclasses.asdict(PROFILES[arguments.profile]),
                "network": network.state_dict(),
                "losses": losses.state_dict(),
                "optimizers": [optimizer.state_dict() for optimizer in optimizers],
                "step": step,
                "seed": arguments.seed,
            }
            torch.save(state, checkpoint.with_suffix(".new"))
            checkpoint.with_suffix(".new").replace(checkpoint)
            draw_curve(log, arguments.out / "curve.png")


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("profile", choices=PROFILES)
    for name in ("photographs", "edgepoint2", "alike", "corpus", "out"):
        parser.add_argument(f"--{name}", type=Path, required=True)
    parser.add_argument("--grow-from", type=Path)
    parser.add_argument("--steps", type=int, default=6_000)
    parser.add_argument("--pairs", type=int, default=8, help="pairs a step")
    parser.add_argument("--rate", type=float, default=1.8e-2, help="learning rate, at its highest")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--device", default="cpu")
    arguments = parser.parse_args(argv)
    if not arguments.photographs.is_dir():
        parser.error(f"{arguments.photographs} is no folder of photographs")
    return arguments


def loader(pairs: Pairs, start: int, arguments: argparse.Namespace) -> Iterator:
    """Yield the batches from step `start` on, made ahead in other processes."""
    return iter(
        torch.utils.data.DataLoader(
            pairs,
            batch_size=None,
            sampler=range(start, arguments.steps),
            num_workers=arguments.workers,
            prefetch_factor=8 if arguments.workers else None,
            worker_init_fn=single_thread,
            multiprocessing_context="spawn" if arguments.workers else None,
        )
    )


def single_thread(_: int) -> None:
    """Leave the cores to the training."""
    cv2.setNumThreads(1)
    torch.set_num_threads(1)


def make_optimizers(network: Network, losses: Losses, rate: float) -> list[torch.optim.Optimizer]:
    """Muon for the convolutions; AdamW for biases, norms and the scale, which do not decay."""
    weights = [p for p in network.parameters() if p.ndim > 1]
    others = [p for p in network.parameters() if p.ndim <= 1] + list(losses.parameters())
    optimizers = [
        Muon(weights, rate),
        torch.optim.AdamW(others, OTHERS_RATE, betas=(0.9, 0.98), weight_decay=0.0),
    ]
    for optimizer in optimizers:
        for group in optimizer.param_groups:
            group["highest_lr"] = group["lr"]
    return optimizers


def set_rates(optimizers: Sequence[torch.optim.Optimizer], step: int, steps: int) -> None:
    """Warm up, then fall along a cosine."""
    cosine = 0.5 * (1 + math.cos(math.pi * step / steps))
    share = min(1.0, step / WARM_UP_STEPS) * (LAST_RATE + (1 - LAST_RATE) * cosine)
    for optimizer in optimizers:
        for group in optimizer.param_groups:
            group["lr"] = group["highest_lr"] * share


def keep_log(log: Path, step: int) -> None:
    """Drop the lines after the checkpoint that training goes on from."""
    lines = log.read_text().splitlines(keepends=True) if log.exists() else []
    log.write_text("".join(line for line in lines if json.loads(line)["step"] <= step))


if __name__ == "__main__":
    main()
