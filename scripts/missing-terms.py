#!/usr/bin/env python3
"""Finds terms that the equations lack and with which they describe the recordings of a real Qube better.

Fits the equations of `qube-hil identify`, each time with other further terms, by multiple shooting to all recordings
but one, with each recording left out in turn. Prints how well the recordings that were left out are explained: the root
mean square of their residuals over windows of 1 s (recordings whose pendulum never comes upright), of 0.5 s (swing) and
of 0.25 s (upright), arm and pendulum. The start state is estimated in each window; the cable's rest angle and the
pendulum's zero in each recording, because homing sets the zeros of both angles anew. This implementation is independent
on purpose: it shares no code with the program.

usage: scripts/missing-terms.py FOLDER [TERM ...]

FOLDER holds recordings as .csv (docs/reference/files.md) at one rate each, up to 500 Hz. A TERM is one of the names
that it prints without FOLDER, or several joined by `+`; without a TERM each is tried by itself. Needs numpy.
"""
import pathlib
import sys
import time

import numpy as np

STEP_S = 0.002
GRAVITY_M_S2 = 9.81
UPRIGHT_COS = -0.5
FRICTION_VELOCITY_RAD_S = 0.05
PRIOR_REST_RAD, REST_SPREAD_RAD, ZERO_SPREAD_RAD = -0.8, 0.5, 0.003

# The equations in volts: every torque and inertia is divided by the motor's torque per volt, k_m / R_m. Names that
# begin with log_ are logarithms. A fit begins at the values of the name plate, with some friction, dead zones, cable
# and delay.
NAME_PLATE_N_M_PER_V = 0.042 / 8.4
BASE = {
    "log_arm": np.log((0.024 * 0.085**2 + 0.095 * 0.085**2 / 12) / NAME_PLATE_N_M_PER_V),
    "log_pendulum": np.log(0.024 * 0.129**2 / 3 / NAME_PLATE_N_M_PER_V),
    "log_gravity": np.log(0.024 * 0.129 * GRAVITY_M_S2 / 2 / NAME_PLATE_N_M_PER_V),
    "log_coupling": np.log(0.024 * 0.129 * 0.085 / 2 / NAME_PLATE_N_M_PER_V),
    "log_arm_damping": np.log(0.05),
    "log_pendulum_damping": np.log(2e-4),
    "coulomb": 0.1,
    "positive_dead_zone": 0.05,
    "negative_dead_zone": 0.1,
    "cable": 0.2,
    "delay": 0.004,
}
# Each term's parameters, with the values at which a fit begins; a parameter of another term has the value in ABSENT.
TERMS = {
    "none": {},
    # Share of the pendulum's inertia about its bearing that acts while the arm swings it round: the thesis's 3/4.
    "inertia": {"inertia_share": 0.75},
    "whole-inertia": {},
    "stribeck": {"stribeck": 0.0, "log_stribeck_velocity": 0.0},
    "coulomb-by-direction": {"coulomb_direction": 0.0},
    "damping-by-direction": {"damping_direction": 0.0},
    "presliding": {"presliding": 0.0, "log_presliding_rad": np.log(0.03)},
    "hysteresis": {"hysteresis": 0.0, "log_hysteresis_rad": np.log(0.3)},
    # The cable has another stiffness beyond its rest angle than before it.
    "cable-by-side": {"cable_side": 0.0},
    "cable-cubic": {"cable_cubic": 0.0},
    # Gravity on an arm that is out of balance or on a base that is not level.
    "tilt": {"tilt_sin": 0.0, "tilt_cos": 0.0},
    "pendulum-coulomb": {"pendulum_coulomb": 0.0},
    "pendulum-drag": {"pendulum_drag": 0.0},
    "arm-drag": {"arm_drag": 0.0},
    # A torque that grows less than the voltage.
    "saturation": {"saturation": 0.0},
    # A first-order lag of the voltage beside the delay, s.
    "lag": {"lag": 0.0005},
    "arm-eccentric": {"arm_sin": 0.0, "arm_cos": 0.0},
    "pendulum-eccentric": {"pendulum_sin": 0.0, "pendulum_cos": 0.0},
}
ABSENT = {name: 0.0 for term in TERMS.values() for name in term}
ABSENT |= {"inertia_share": 0.75, "log_presliding_rad": np.log(0.03), "log_hysteresis_rad": np.log(0.3)}
FIXED = {"whole-inertia": {"inertia_share": 1.0}}
SPREADS = {name: 2.0 if name == "log_pendulum_damping" else 1.0 for name in BASE if name.startswith("log_")}
SPREADS |= {"log_stribeck_velocity": 1.0, "log_presliding_rad": 1.0, "log_hysteresis_rad": 0.7}
NOT_NEGATIVE = {"coulomb", "positive_dead_zone", "negative_dead_zone", "cable", "delay", "lag", "pendulum_coulomb",
                "presliding", "hysteresis"}
DIFFERENCE = 1e-5


class Recording:
    def __init__(self, path):
        columns = np.genfromtxt(path, delimiter=",", skip_header=1)
        self.name = path.stem
        self.time, self.theta, self.alpha, _, _, self.voltage = columns[:, :6].T
        self.voltage = np.where(np.isnan(self.voltage), np.roll(self.voltage, 1), self.voltage)
        self.period = self.time[1] - self.time[0]

    def windows(self):
        """Returns the windows: index of the first sample, index after the last one, and kind (0 hanging, 1 swing,
        2 upright)."""
        first, windows = int(np.searchsorted(self.time, self.time[0] + 0.04 - 1e-9)), []
        upright = lambda first, end: bool((np.cos(self.alpha[first:end]) < UPRIGHT_COS).any())
        end_after = lambda seconds: min(len(self.time), first + round(seconds / self.period) + 1)
        comes_upright = upright(0, len(self.time))
        while first + 1 < len(self.time):
            end, kind = end_after(1.0), 0
            if comes_upright:
                end, kind = end_after(0.5), 1
                if upright(first, end):
                    end = end_after(0.25)
                    kind = 2 if upright(first, end) else 1
            if (end - 1 - first) * self.period >= 0.12:
                windows.append((first, end, kind))
            first = end - 1
        return windows

    def voltage_integral(self, lag):
        """Returns the times and the integral of the held voltage after a first-order lag of `lag` s."""
        times = np.append(self.time, self.time[-1] + self.period)
        if lag <= 0.0:
            return times, np.append(0.0, np.cumsum(self.voltage) * self.period)
        decay, lagging, integral = np.exp(-self.period / lag), self.voltage[0], [0.0]
        for held in self.voltage:
            integral.append(integral[-1] + held * self.period + (lagging - held) * lag * (1.0 - decay))
            lagging = held + (lagging - held) * decay
        return times, np.array(integral)

    def built_up(self, angle):
        """Returns the torque at each sample of an element that resists the arm elastically until it slides (Dahl's
        friction), as a share of its largest torque; `angle` is the angle, rad, over which the torque builds up."""
        share, shares = 0.0, [0.0]
        for moved in np.diff(self.theta):
            share = np.sign(moved) + (share - np.sign(moved)) * np.exp(-abs(moved) / angle)
            shares.append(share)
        return np.array(shares)


class Windows:
    """Windows of one length and rate, simulated side by side."""

    def __init__(self, recordings, places):
        self.recordings, self.places = recordings, places
        self.recording = np.array([place[0] for place in places])
        self.kind = np.array([place[3] for place in places])
        pick = lambda key: np.array([getattr(recordings[r], key)[first:end] for r, first, end, _ in places])
        self.time, self.theta, self.alpha = pick("time"), pick("theta"), pick("alpha")
        self.steps_a_sample = round(recordings[places[0][0]].period / STEP_S)
        self.steps = (self.theta.shape[1] - 1) * self.steps_a_sample

        def slope(key):
            slopes = []
            for r, first, _, _ in places:
                angle, times = getattr(recordings[r], key), recordings[r].time
                before, after = max(0, first - 3), min(len(angle) - 1, first + 3)
                slopes.append((angle[after] - angle[before]) / (times[after] - times[before]))
            return np.array(slopes)

        self.starts = np.stack([self.theta[:, 0], self.alpha[:, 0], slope("theta"), slope("alpha")], axis=1)
        self.kept = {}

    def keep(self, key, compute):
        if key not in self.kept:
            if len(self.kept) > 100:
                self.kept.clear()
            self.kept[key] = compute()
        return self.kept[key]

    def mean_voltages(self, delay, lag):
        """Returns the mean voltage of each integration step, window by window."""
        grid = self.time[:, :1] + STEP_S * np.arange(self.steps + 1) - delay
        rows = [np.interp(own, *self.recordings[r].voltage_integral(lag)) for own, r in zip(grid, self.recording)]
        return np.diff(np.array(rows)) / STEP_S

    def built_up(self, angle):
        shares = [recording.built_up(angle) for recording in self.recordings]
        return np.array([shares[r][first:end][0] for r, first, end, _ in self.places])

    def simulate(self, sets, starts, rests):
        """Returns theta and alpha at each sample, for several sets of parameters with start states (set, window, 4) and
        rest angles (set, window); both results have the shape (set, window, sample)."""
        number = lambda name: np.array([own[name] for own in sets])[:, None]
        p = {name: np.exp(number(name)) if name.startswith("log_") else number(name) for name in sets[0]}
        present = {name for name in ABSENT if any(own[name] != ABSENT[name] for own in sets)}
        voltages = np.stack([
            self.keep(("voltage", own["delay"], own["lag"]), lambda: self.mean_voltages(own["delay"], own["lag"]))
            for own in sets
        ])
        voltages = (np.maximum(voltages - p["positive_dead_zone"][:, :, None], 0.0)
                    + np.minimum(voltages + p["negative_dead_zone"][:, :, None], 0.0))
        voltages *= 1.0 - p["saturation"][:, :, None] * np.abs(voltages)
        elastic = {}
        for name in ("presliding", "hysteresis"):
            if name in present:
                angles = p[f"log_{name}_rad"]
                shares = [self.keep((name, angle), lambda: self.built_up(angle)) for angle in angles[:, 0]]
                elastic[name] = np.stack(shares)

        def accelerations(theta, alpha, theta_dot, alpha_dot, voltage):
            sin, cos = np.sin(alpha), np.cos(alpha)
            share = theta_dot / FRICTION_VELOCITY_RAD_S
            friction = p["coulomb"] * share / (1.0 / 3.0 + np.abs(share))
            if "stribeck" in present:
                friction = friction * (1.0 + p["stribeck"] * np.exp(-(theta_dot / p["log_stribeck_velocity"]) ** 2))
            if "coulomb_direction" in present:
                friction = friction * (1.0 + p["coulomb_direction"] * np.sign(theta_dot))
            torque = voltage - p["log_arm_damping"] * theta_dot - friction - p["cable"] * (theta - rests)
            if "damping_direction" in present:
                torque = torque - p["damping_direction"] * np.abs(theta_dot)
            if "cable_side" in present:
                torque = torque - p["cable_side"] * np.maximum(theta - rests, 0.0)
            if "cable_cubic" in present:
                torque = torque - p["cable_cubic"] * (theta - rests) ** 3
            if present & {"tilt_sin", "tilt_cos"}:
                torque = torque - p["tilt_sin"] * np.sin(theta) - p["tilt_cos"] * np.cos(theta)
            if "arm_drag" in present:
                torque = torque - p["arm_drag"] * np.abs(theta_dot) * theta_dot
            for name, shares in elastic.items():
                torque = torque - p[name] * shares
            swung = p["inertia_share"] * p["log_pendulum"]
            centrifugal = swung * sin * cos * theta_dot
            arm = torque + (p["log_coupling"] * sin * alpha_dot - 2.0 * centrifugal) * alpha_dot
            pendulum = -p["log_gravity"] * sin + centrifugal * theta_dot - p["log_pendulum_damping"] * alpha_dot
            if "pendulum_coulomb" in present:
                pendulum = pendulum - p["pendulum_coulomb"] * np.tanh(alpha_dot / 0.3)
            if "pendulum_drag" in present:
                pendulum = pendulum - p["pendulum_drag"] * np.abs(alpha_dot) * alpha_dot
            m11, m12, m22 = p["log_arm"] + swung * sin * sin, p["log_coupling"] * cos, p["log_pendulum"]
            determinant = m11 * m22 - m12 * m12
            return (m22 * arm - m12 * pendulum) / determinant, (m11 * pendulum - m12 * arm) / determinant

        theta, alpha, theta_dot, alpha_dot = (starts[:, :, entry].copy() for entry in range(4))
        thetas, alphas, h = [theta], [alpha], STEP_S
        for step in range(self.steps):
            voltage = voltages[:, :, step]
            a1, b1 = accelerations(theta, alpha, theta_dot, alpha_dot, voltage)
            v2, w2 = theta_dot + h / 2 * a1, alpha_dot + h / 2 * b1
            a2, b2 = accelerations(theta + h / 2 * theta_dot, alpha + h / 2 * alpha_dot, v2, w2, voltage)
            v3, w3 = theta_dot + h / 2 * a2, alpha_dot + h / 2 * b2
            a3, b3 = accelerations(theta + h / 2 * v2, alpha + h / 2 * w2, v3, w3, voltage)
            v4, w4 = theta_dot + h * a3, alpha_dot + h * b3
            a4, b4 = accelerations(theta + h * v3, alpha + h * w3, v4, w4, voltage)
            moved = h / 6 * (theta_dot + 2 * v2 + 2 * v3 + v4)
            theta, alpha = theta + moved, alpha + h / 6 * (alpha_dot + 2 * w2 + 2 * w3 + w4)
            theta_dot = theta_dot + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
            alpha_dot = alpha_dot + h / 6 * (b1 + 2 * b2 + 2 * b3 + b4)
            for name, shares in elastic.items():
                decay = np.exp(-np.abs(moved) / p[f"log_{name}_rad"])
                elastic[name] = np.sign(moved) + (shares - np.sign(moved)) * decay
            if (step + 1) % self.steps_a_sample == 0:
                thetas.append(theta)
                alphas.append(alpha)
        thetas, alphas = np.stack(thetas, axis=2), np.stack(alphas, axis=2)
        wave = lambda name, of: p[name][:, :, None] * of
        thetas = thetas + wave("arm_sin", np.sin(thetas)) + wave("arm_cos", np.cos(thetas))
        alphas = alphas + wave("pendulum_sin", np.sin(alphas)) + wave("pendulum_cos", np.cos(alphas))
        return thetas, alphas


class Fit:
    """A fit by multiple shooting with Levenberg-Marquardt steps, which eliminate the start states window by window."""

    def __init__(self, recordings, free, values):
        self.recordings, self.free, self.values = recordings, free, dict(values)
        places = {}
        for r, recording in enumerate(recordings):
            for first, end, kind in recording.windows():
                places.setdefault((recording.period, end - first), []).append((r, first, end, kind))
        self.groups = [Windows(recordings, own) for own in places.values()]
        self.starts = [group.starts for group in self.groups]
        self.rests = np.full(len(recordings), PRIOR_REST_RAD)
        self.zeros = np.zeros(len(recordings))
        self.scales = np.full((3, 2), 0.01)

    def residuals(self, values, starts, rests, zeros):
        for group, own in zip(self.groups, starts):
            theta, alpha = group.simulate([values], own[None], rests[group.recording][None])
            yield group, theta[0] - group.theta, alpha[0] + zeros[group.recording][:, None] - group.alpha

    def state(self):
        return self.values, self.starts, self.rests, self.zeros

    def cost(self, values, starts, rests, zeros):
        total = (((rests - PRIOR_REST_RAD) / REST_SPREAD_RAD) ** 2).sum() + ((zeros / ZERO_SPREAD_RAD) ** 2).sum()
        for group, theta, alpha in self.residuals(values, starts, rests, zeros):
            scale = self.scales[group.kind]
            square = ((theta / scale[:, :1]) ** 2).sum(1) + ((alpha / scale[:, 1:]) ** 2).sum(1)
            count = 2 * theta.shape[1]
            root = np.sqrt(square / count)
            total += np.where(root <= 2.0, square, count * (4.0 * root - 4.0)).sum()
        for name in set(self.free) & set(SPREADS):
            total += ((values[name] - (BASE | ABSENT)[name]) / SPREADS[name]) ** 2
        return total if np.isfinite(total) else np.inf

    def step(self, damping):
        free, recordings = len(self.free), len(self.recordings)
        size, own = free + 2 * recordings, free + 2
        matrix, gradient, eliminated = np.zeros((size, size)), np.zeros(size), []
        for group, starts in zip(self.groups, self.starts):
            rests, scale = self.rests[group.recording], self.scales[group.kind]
            changed = [self.values | {name: self.values[name] + DIFFERENCE} for name in self.free]
            sets = [self.values, *changed, self.values] + 4 * [self.values]
            all_rests = np.stack([rests] * (free + 1) + [rests + DIFFERENCE] + [rests] * 4)
            moved = [starts + DIFFERENCE * np.eye(4)[entry] for entry in range(4)]
            theta, alpha = group.simulate(sets, np.stack([starts] * (free + 2) + moved), all_rests)
            alpha = alpha + self.zeros[group.recording][:, None]
            scaled = lambda t, a: np.concatenate([t / scale[:, :1], a / scale[:, 1:]], axis=1)
            residual = scaled(theta[0] - group.theta, alpha[0] - group.alpha)
            slopes = [scaled(t - theta[0], a - alpha[0]) / DIFFERENCE for t, a in zip(theta[1:], alpha[1:])]
            slopes.insert(free + 1, scaled(np.zeros_like(group.theta), np.ones_like(group.alpha)))
            slopes = np.stack(slopes, axis=2)
            weight = np.minimum(1.0, 2.0 / np.sqrt((residual**2).mean(1)))
            square = np.einsum("w,wni,wnj->wij", weight, slopes, slopes)
            pull = np.einsum("w,wni,wn->wi", weight, slopes, residual)
            inverse = np.linalg.inv(square[:, own:, own:] * (1.0 + damping * np.eye(4)))
            coupling = square[:, :own, own:] @ inverse
            reduced = square[:, :own, :own] * (1.0 + damping * np.eye(own)) - coupling @ square[:, own:, :own]
            reduced_pull = pull[:, :own] - (coupling @ pull[:, own:, None])[:, :, 0]
            indices = np.array([[*range(free), free + r, free + recordings + r] for r in group.recording])
            for place, block, own_pull in zip(indices, reduced, reduced_pull):
                matrix[np.ix_(place, place)] += block
                gradient[place] += own_pull
            eliminated.append((inverse, square[:, own:, :own], pull[:, own:], indices))
        matrix[np.arange(free), np.arange(free)] += 1e-6
        for index, name in enumerate(self.free):
            if name in SPREADS:
                matrix[index, index] += SPREADS[name] ** -2
                gradient[index] += (self.values[name] - (BASE | ABSENT)[name]) / SPREADS[name] ** 2
        for first, offsets, mean, spread in ((free, self.rests, PRIOR_REST_RAD, REST_SPREAD_RAD),
                                             (free + recordings, self.zeros, 0.0, ZERO_SPREAD_RAD)):
            places = first + np.arange(recordings)
            matrix[places, places] += spread**-2
            gradient[places] += (offsets - mean) / spread**2
        for index, name in enumerate(self.free):
            if name in NOT_NEGATIVE and self.values[name] <= 0.0 and gradient[index] > 0.0:
                matrix[index], matrix[:, index], matrix[index, index], gradient[index] = 0.0, 0.0, 1.0, 0.0
        change = -np.linalg.solve(matrix, gradient)
        values = dict(self.values)
        for name, by in zip(self.free, change):
            values[name] = max(values[name] + by, 0.0) if name in NOT_NEGATIVE else values[name] + by
        starts = []
        for own_starts, (inverse, across, pull, indices) in zip(self.starts, eliminated):
            by = pull + np.einsum("wsi,wi->ws", across, change[indices])
            starts.append(own_starts - (inverse @ by[:, :, None])[:, :, 0])
        return values, starts, self.rests + change[free:free + recordings], self.zeros + change[free + recordings:]

    def minimise(self, most_steps=30, least_gain=1e-5):
        damping, cost = 1e-3, self.cost(*self.state())
        for _ in range(most_steps):
            for _ in range(7):
                with np.errstate(all="ignore"):
                    try:
                        next_state = self.step(damping)
                        next_cost = self.cost(*next_state)
                    except np.linalg.LinAlgError:
                        next_cost = np.inf
                if next_cost < cost:
                    break
                damping *= 5.0
            else:
                return
            self.values, self.starts, self.rests, self.zeros = next_state
            gain, cost, damping = (cost - next_cost) / cost, next_cost, max(0.2 * damping, 1e-9)
            if gain < least_gain:
                return

    def sums(self, weighted):
        """Returns the sums of squared residuals by kind and angle, and the number of samples by kind; both with the
        weights of the fit if `weighted`."""
        squares, counts = np.zeros((3, 2)), np.zeros(3)
        for group, theta, alpha in self.residuals(*self.state()):
            scale = self.scales[group.kind]
            mean = (((theta / scale[:, :1]) ** 2).mean(1) + ((alpha / scale[:, 1:]) ** 2).mean(1)) / 2
            weight = np.minimum(1.0, 2.0 / np.sqrt(mean)) if weighted else np.ones_like(mean)
            for angle, residual in enumerate((theta, alpha)):
                np.add.at(squares[:, angle], group.kind, weight * (residual**2).sum(1))
            np.add.at(counts, group.kind, weight * theta.shape[1])
        return squares, counts

    def run(self, rounds, **limits):
        for _ in range(rounds):
            self.minimise(**limits)
            squares, counts = self.sums(weighted=True)
            seen = counts > 0
            self.scales[seen] = np.maximum(np.sqrt(squares[seen] / counts[seen, None]), 1e-3)
        return self


def left_out(whole, free, held_out):
    """Returns the sums of the squared residuals of recording `held_out` under a fit to the others, and the numbers of
    its samples."""
    others = [recording for index, recording in enumerate(whole.recordings) if index != held_out]
    fit = Fit(others, free, whole.values)
    fit.scales = whole.scales.copy()
    fit.rests, fit.zeros = np.delete(whole.rests, held_out), np.delete(whole.zeros, held_out)
    fit.run(1, most_steps=8, least_gain=1e-4)
    own = Fit([whole.recordings[held_out]], [], fit.values)
    own.scales = fit.scales
    own.rests[:] = np.median(fit.rests)
    own.minimise(most_steps=20)
    return own.sums(weighted=False)


def main():
    if len(sys.argv) < 2:
        sys.exit(__doc__ + "\nterms: " + ", ".join(TERMS))
    recordings = [Recording(path) for path in sorted(pathlib.Path(sys.argv[1]).glob("*.csv"))]
    terms = sys.argv[2:] or list(TERMS)
    if not recordings:
        sys.exit(f"{sys.argv[1]}: there are no .csv files")
    if unknown := {part for term in terms for part in term.split("+")} - set(TERMS):
        sys.exit(f"there is no term {unknown.pop()}; there are {', '.join(TERMS)}")
    base = Fit(recordings, list(BASE), BASE | ABSENT).run(4)
    print(f"{'left out, RMS in mrad':34} {'chirp 1 s':>13} {'swing 0.5 s':>13} {'upright 0.25 s':>15}")
    for term in terms:
        begun = time.monotonic()
        own = {name: value for part in term.split("+") for name, value in TERMS[part].items()}
        fixed = {name: value for part in term.split("+") for name, value in FIXED.get(part, {}).items()}
        free = list(BASE) + [name for name in own if name not in fixed]
        whole = Fit(recordings, free, base.values | own | fixed)
        whole.starts, whole.rests, whole.zeros = list(base.starts), base.rests.copy(), base.zeros.copy()
        whole.scales = base.scales.copy()
        whole.run(2)
        sums = [left_out(whole, free, index) for index in range(len(recordings))]
        squares, counts = (sum(parts) for parts in zip(*sums))
        roots = 1e3 * np.sqrt(squares / np.maximum(counts, 1.0)[:, None])
        shown = [f"{theta:.2f}/{alpha:.2f}" for theta, alpha in roots]
        values = " ".join(f"{name} {whole.values[name]:.3g}" for name in own)
        seconds = time.monotonic() - begun
        print(f"{term:34} {shown[0]:>13} {shown[1]:>13} {shown[2]:>15}  {values} ({seconds:.0f} s)", flush=True)


if __name__ == "__main__":
    main()
