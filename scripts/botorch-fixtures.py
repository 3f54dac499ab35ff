#!/usr/bin/env python3
"""Writes tests/fixtures/botorch_fixture_*.json: four small problems with the numbers that BoTorch computes for
them (objective, gradients, posterior, expected improvement, fit). tests/virtual_time/surrogate_botorch.rs reads them.
Needs `pip install botorch` (0.18; torch for the CPU).

usage: scripts/botorch-fixtures.py [FOLDER]
"""
import json
import pathlib
import sys

import botorch
import gpytorch
import torch
from botorch.acquisition import ExpectedImprovement, LogExpectedImprovement
from botorch.fit import fit_gpytorch_mll
from botorch.models import SingleTaskGP
from botorch.models.transforms import Normalize, Standardize
from botorch.models.utils.gpytorch_modules import get_covar_module_with_dim_scaled_prior, get_gaussian_likelihood_with_gamma_prior
from botorch.optim import optimize_acqf
from gpytorch.kernels import MaternKernel, RBFKernel, ScaleKernel
from gpytorch.mlls import ExactMarginalLogLikelihood
from gpytorch.priors import GammaPrior

torch.set_default_dtype(torch.float64)
torch.set_num_threads(1)
BOUNDS = torch.tensor([[0.0, -2.0, 10.0], [1.0, 3.0, 11.0]])
DIMENSIONS = BOUNDS.shape[1]


def data(n, seed):
    generator = torch.Generator().manual_seed(seed)
    unit = torch.rand(n, DIMENSIONS, generator=generator)
    y = 400 * torch.exp(-((unit - 0.4) ** 2).sum(-1)) + 50 * torch.sin(5 * unit[:, 0])
    y = y + 10 * torch.randn(n, generator=generator)
    return BOUNDS[0] + unit * (BOUNDS[1] - BOUNDS[0]), y.unsqueeze(-1)


def build(x, y, priors, kernel):
    transforms = dict(input_transform=Normalize(DIMENSIONS, bounds=BOUNDS), outcome_transform=Standardize(1))
    if priors == "lognormal":
        covariance = get_covar_module_with_dim_scaled_prior(DIMENSIONS, use_rbf_kernel=kernel == "squared-exponential")
        return SingleTaskGP(x, y, covar_module=covariance, **transforms)
    prior = GammaPrior(3.0, 6.0)
    base = (RBFKernel(ard_num_dims=DIMENSIONS, lengthscale_prior=prior) if kernel == "squared-exponential"
            else MaternKernel(nu=2.5, ard_num_dims=DIMENSIONS, lengthscale_prior=prior))
    covariance = ScaleKernel(base, outputscale_prior=GammaPrior(2.0, 0.15))
    return SingleTaskGP(x, y, covar_module=covariance, likelihood=get_gaussian_likelihood_with_gamma_prior(), **transforms)


def base_of(model):
    kernel_module = model.covar_module
    return kernel_module.base_kernel if isinstance(kernel_module, ScaleKernel) else kernel_module


def hyperparameters(model):
    kernel_module = model.covar_module
    return dict(mean_constant=model.mean_module.constant.item(),
                lengthscale=base_of(model).lengthscale.detach().flatten().tolist(),
                outputscale=kernel_module.outputscale.item() if isinstance(kernel_module, ScaleKernel) else 1.0,
                noise=model.likelihood.noise.item())


def set_hyperparameters(model, values):
    kernel_module = model.covar_module
    model.mean_module.constant = values["mean_constant"]
    base_of(model).lengthscale = torch.tensor(values["lengthscale"])
    if isinstance(kernel_module, ScaleKernel):
        kernel_module.outputscale = values["outputscale"]
    model.likelihood.noise = values["noise"]


def evaluation(model, x_test, best_f):
    model.train()
    n = model.train_targets.numel()
    objective = ExactMarginalLogLikelihood(model.likelihood, model)(model(*model.train_inputs), model.train_targets) * n
    prior = sum(p.log_prob(closure(module)).sum() for _, module, p, closure, _ in model.named_priors())
    model.zero_grad()
    evidence = model.likelihood(model(*model.train_inputs)).log_prob(model.train_targets)
    evidence.backward()
    gradients = dict(d_lml_d_mean_constant=model.mean_module.raw_constant.grad.item(),
                     d_lml_d_raw_lengthscale=base_of(model).raw_lengthscale.grad.flatten().tolist())
    model.eval()
    with torch.no_grad():
        posterior = model.posterior(x_test)
        return dict(hyperparameters=hyperparameters(model), objective_total=objective.item(),
                    log_marginal_likelihood=evidence.item(), log_prior_total=prior.item(), **gradients,
                    posterior_mean=posterior.mean.flatten().tolist(), posterior_var=posterior.variance.flatten().tolist(),
                    ei=ExpectedImprovement(model, best_f)(x_test[:, None]).tolist(),
                    log_ei=LogExpectedImprovement(model, best_f)(x_test[:, None]).tolist())


def fixture(folder, priors, kernel, n, seed):
    x, y = data(n, seed)
    x_test = torch.cat([data(6, seed + 1)[0], x[:2]])
    best_f = y.max()
    model = build(x, y, priors, kernel)
    set_hyperparameters(model, dict(mean_constant=0.1, lengthscale=[.3, .5, .8],
                                    outputscale=1.3 if priors == "gamma" else 1.0, noise=0.02))
    at_reference = evaluation(model, x_test, best_f)
    best = None
    for start in range(8):
        torch.manual_seed(start)
        trial = build(x, y, priors, kernel)
        if start:
            set_hyperparameters(trial, dict(mean_constant=0.0, lengthscale=(0.1 + 2 * torch.rand(DIMENSIONS)).tolist(),
                                            outputscale=1.0, noise=float(10 ** (-3 + 2 * torch.rand(1)))))
        fit_gpytorch_mll(ExactMarginalLogLikelihood(trial.likelihood, trial))
        result = evaluation(trial, x_test, best_f)
        if best is None or result["objective_total"] > best["objective_total"]:
            best, winner = result, trial
    torch.manual_seed(0)
    _, optimum = optimize_acqf(LogExpectedImprovement(winner, best_f), BOUNDS, q=1, num_restarts=16, raw_samples=512)
    transform = model.outcome_transform
    path = folder / f"botorch_fixture_{priors}_{kernel}_n{n}.json"
    path.write_text(json.dumps(dict(
        versions=dict(botorch=botorch.__version__, gpytorch=gpytorch.__version__, torch=torch.__version__),
        kernel=kernel, bounds_lo=BOUNDS[0].tolist(), bounds_hi=BOUNDS[1].tolist(), x=x.tolist(), y=y.flatten().tolist(),
        y_mean=transform.means.item(), y_std=transform.stdvs.item(), best_f=best_f.item(), x_test=x_test.tolist(),
        at_reference=at_reference, best_fit_of_8_starts=best, acquisition_optimum=dict(log_ei=optimum.item())), indent=1) + "\n")
    print("wrote", path)


here = pathlib.Path(__file__).resolve().parent.parent
folder = pathlib.Path(sys.argv[1]) if len(sys.argv) > 1 else here / "tests" / "fixtures"
folder.mkdir(parents=True, exist_ok=True)
for priors in ("gamma", "lognormal"):
    for kernel in ("matern52", "squared-exponential"):
        fixture(folder, priors, kernel, 10, 5)
