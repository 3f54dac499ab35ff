#!/usr/bin/env python3
"""Times BoTorch and this project's surrogate on the same problem, one after the other, and prints
the ratios: a fit (gamma priors, constant mean, ARD Matérn 5/2, d = 8) and the maximisation of log EI
(10 starts, 512 raw points). Each program uses one thread.

Needs `pip install botorch`. Pin the script to one core: taskset -c 1 scripts/compare-botorch.py [N ...]
N are numbers of observations, from 25, 100, 500, 1000 and 2000 [25 100 500]. A ratio is the time of BoTorch
divided by the time of this project.
"""
import json
import os
import pathlib
import statistics
import subprocess
import sys
import time
import warnings

os.environ["OMP_NUM_THREADS"] = "1"
import botorch
import torch
from botorch.acquisition import LogExpectedImprovement
from botorch.fit import fit_gpytorch_mll
from botorch.models import SingleTaskGP
from botorch.models.transforms import Standardize
from botorch.models.utils.gpytorch_modules import get_gaussian_likelihood_with_gamma_prior, get_matern_kernel_with_gamma_prior
from botorch.optim import optimize_acqf
from gpytorch.mlls import ExactMarginalLogLikelihood

warnings.filterwarnings("ignore")
torch.set_num_threads(1)
torch.set_default_dtype(torch.float64)
DIMENSIONS = 8
CENTRE = torch.tensor([.3, .6, .5, .4, .7, .2, .5, .5])
WEIGHTS = torch.tensor([3., 2., 2.5, .5, 1., 1.5, .1, .05])
REPEATS = {25: 9, 100: 5}


def botorch_seconds(n):
    """Returns the median times of the fit and of the maximisation, s."""
    fits, maxima = [], []
    for repeat in range(REPEATS.get(n, 3) + 1):
        u = torch.rand(n, DIMENSIONS, generator=torch.Generator().manual_seed(repeat))
        y = 540 * torch.exp(-(WEIGHTS * (u - CENTRE) ** 2).sum(-1)) + 20 * torch.sin(6 * u[:, 0])
        y = (y + 15 * torch.randn(n, generator=torch.Generator().manual_seed(100 + repeat))).unsqueeze(-1)
        model = SingleTaskGP(u, y, covar_module=get_matern_kernel_with_gamma_prior(DIMENSIONS),
                             likelihood=get_gaussian_likelihood_with_gamma_prior(), outcome_transform=Standardize(1))
        start = time.perf_counter()
        fit_gpytorch_mll(ExactMarginalLogLikelihood(model.likelihood, model))
        fitted = time.perf_counter()
        box = torch.stack([torch.zeros(DIMENSIONS), torch.ones(DIMENSIONS)])
        optimize_acqf(LogExpectedImprovement(model, y.max()), box, q=1, num_restarts=10, raw_samples=512)
        if repeat:    # the first repetition warms up and does not count
            fits.append(fitted - start)
            maxima.append(time.perf_counter() - fitted)
    return statistics.median(fits), statistics.median(maxima)


def our_seconds(name):
    estimates = pathlib.Path("target/criterion", name, "new", "estimates.json")
    return json.loads(estimates.read_text())["median"]["point_estimate"] * 1e-9


os.chdir(pathlib.Path(__file__).resolve().parent.parent)
sizes = [int(n) for n in sys.argv[1:]] or [25, 100, 500]
subprocess.run(["cargo", "bench", "--bench", "surrogate", "--", "--measurement-time", "2"], check=True,
               stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
print(f"BoTorch {botorch.__version__}, torch {torch.__version__}; medians in s")
print(f"{'n':>5} {'fit BoTorch':>12} {'ours':>9} {'ratio':>6}   {'log EI BoTorch':>14} {'ours':>9} {'ratio':>6}")
for n in sizes:
    fit, maximum = botorch_seconds(n)
    our_fit, our_maximum = our_seconds(f"fit/{n}"), our_seconds(f"maximise/log-ei/{n}")
    print(f"{n:5} {fit:12.4f} {our_fit:9.4f} {fit / our_fit:6.0f}   {maximum:14.4f} {our_maximum:9.4f} {maximum / our_maximum:6.0f}",
          flush=True)
