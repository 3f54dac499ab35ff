/// Stopping criteria of [`minimise`], which ends as soon as one of them is met, or earlier where no
/// step lowers the value enough.
#[derive(Clone, Copy, Debug)]
pub(super) struct Tolerances {
    /// Largest size of an entry of the gradient, apart from coordinates held at a bound.
    pub gradient: f64,
    /// Largest decrease of the value in each of two iterations in a row, relative to `1 + |value|`.
    pub decrease: f64,
    /// Largest number of iterations.
    pub iterations: usize,
}

/// The result of [`minimise`].
#[derive(Clone, Debug)]
pub(super) struct Minimum {
    pub point: Vec<f64>,
    pub value: f64,
}

/// Number of last steps whose change of the gradient is remembered.
const MEMORY: usize = 12;
/// Fraction of the decrease predicted by the gradient that a step must reach (Armijo's condition).
const SUFFICIENT: f64 = 1e-4;

/// Minimises a smooth function over a box by projected L-BFGS.
///
/// Each iteration fixes the coordinates that are at a bound and whose descent direction points
/// outwards. In the other coordinates it takes the quasi-Newton step (two-loop recursion, Nocedal
/// and Wright 2006, algorithm 7.4), projects the step onto the box and shortens it until Armijo's
/// condition holds along the projected path (Bertsekas 1982). `function` writes the gradient to its
/// second argument and returns the value; after a value that is not finite the step is shortened.
/// If the value at the start is not finite, the result is the start.
pub(super) fn minimise(
    mut function: impl FnMut(&[f64], &mut [f64]) -> f64,
    start: &[f64],
    lower: &[f64],
    upper: &[f64],
    tolerances: Tolerances,
) -> Minimum {
    let dimensions = start.len();
    let mut point: Vec<f64> = (0..dimensions).map(|i| start[i].clamp(lower[i], upper[i])).collect();
    let mut gradient = vec![0.0; dimensions];
    let mut value = function(&point, &mut gradient);
    let mut memory: Vec<Pair> = Vec::with_capacity(MEMORY);
    let mut trial_gradient = vec![0.0; dimensions];
    let mut stalled = 0;

    for _ in 0..tolerances.iterations {
        let free: Vec<bool> = (0..dimensions)
            .map(|i| {
                let held_below = point[i] <= lower[i] && gradient[i] >= 0.0;
                let held_above = point[i] >= upper[i] && gradient[i] <= 0.0;
                !(held_below || held_above)
            })
            .collect();
        let steepest =
            (0..dimensions).filter(|&i| free[i]).map(|i| gradient[i].abs()).fold(0.0, f64::max);
        if !value.is_finite() || steepest <= tolerances.gradient {
            break;
        }
        let mut direction = quasi_newton_direction(&gradient, &free, &memory);
        if masked_dot(&direction, &gradient, &free) >= 0.0 {
            memory.clear();
            direction = quasi_newton_direction(&gradient, &free, &memory);
        }
        // Without remembered curvature the step is a guess: its largest entry is at most 0.1.
        let mut step = if memory.is_empty() { (0.1 / steepest).min(1.0) } else { 1.0 };

        let mut accepted = None;
        for _ in 0..40 {
            let trial: Vec<f64> = (0..dimensions)
                .map(|i| (point[i] + step * direction[i]).clamp(lower[i], upper[i]))
                .collect();
            let predicted: f64 = (0..dimensions).map(|i| gradient[i] * (trial[i] - point[i])).sum();
            let trial_value = function(&trial, &mut trial_gradient);
            if trial_value.is_finite() && trial_value <= value + SUFFICIENT * predicted.min(0.0) {
                accepted = Some((trial, trial_value));
                break;
            }
            // The next step goes to the minimum of the parabola through both values and the slope,
            // held within 0.1 to 0.5 of this step.
            let curvature = trial_value - value - predicted;
            let shrink = if curvature > 0.0 { -0.5 * predicted / curvature } else { 0.5 };
            step *= if shrink.is_finite() { shrink.clamp(0.1, 0.5) } else { 0.1 };
        }
        let Some((trial, trial_value)) = accepted else {
            if memory.is_empty() {
                break;
            }
            memory.clear();
            continue;
        };

        let pair = Pair::new(&point, &trial, &gradient, &trial_gradient);
        if let Some(pair) = pair {
            if memory.len() == MEMORY {
                memory.remove(0);
            }
            memory.push(pair);
        }
        let decrease = value - trial_value;
        point = trial;
        value = trial_value;
        std::mem::swap(&mut gradient, &mut trial_gradient);
        stalled =
            if decrease <= tolerances.decrease * (1.0 + value.abs()) { stalled + 1 } else { 0 };
        if stalled == 2 {
            break;
        }
    }
    Minimum { point, value }
}

/// A step and the change of the gradient along it.
struct Pair {
    step: Vec<f64>,
    change: Vec<f64>,
}

impl Pair {
    /// The pair for a step between two points; `None` if the curvature along it is not clearly
    /// positive.
    fn new(from: &[f64], to: &[f64], gradient_from: &[f64], gradient_to: &[f64]) -> Option<Self> {
        let difference =
            |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| b - a).collect::<Vec<_>>();
        let step = difference(from, to);
        let change = difference(gradient_from, gradient_to);
        let curvature: f64 = step.iter().zip(&change).map(|(s, y)| s * y).sum();
        let square: f64 = change.iter().map(|y| y * y).sum();
        (curvature > 1e-12 * square && square > 0.0).then_some(Self { step, change })
    }
}

/// The direction `-H g` on the free coordinates and 0 on the others, with the gradient `g` and the
/// approximate inverse Hessian `H` that the remembered pairs define.
fn quasi_newton_direction(gradient: &[f64], free: &[bool], memory: &[Pair]) -> Vec<f64> {
    let mut q: Vec<f64> =
        gradient.iter().zip(free).map(|(g, f)| if *f { *g } else { 0.0 }).collect();
    let mut kept = Vec::with_capacity(memory.len());
    for pair in memory.iter().rev() {
        // A pair may lose its positive curvature when coordinates are fixed.
        let curvature = masked_dot(&pair.step, &pair.change, free);
        let square = masked_dot(&pair.change, &pair.change, free);
        if curvature <= 1e-12 * square || square == 0.0 {
            continue;
        }
        let weight = masked_dot(&pair.step, &q, free) / curvature;
        add_scaled(&mut q, -weight, &pair.change, free);
        kept.push((pair, curvature, square, weight));
    }
    if let Some((_, curvature, square, _)) = kept.first() {
        let scale = curvature / square;
        q.iter_mut().for_each(|q| *q *= scale);
    }
    for (pair, curvature, _, weight) in kept.into_iter().rev() {
        let correction = masked_dot(&pair.change, &q, free) / curvature;
        add_scaled(&mut q, weight - correction, &pair.step, free);
    }
    q.iter_mut().for_each(|q| *q = -*q);
    q
}

fn masked_dot(a: &[f64], b: &[f64], free: &[bool]) -> f64 {
    a.iter().zip(b).zip(free).map(|((a, b), f)| if *f { a * b } else { 0.0 }).sum()
}

fn add_scaled(to: &mut [f64], factor: f64, term: &[f64], free: &[bool]) {
    for ((to, term), f) in to.iter_mut().zip(term).zip(free) {
        if *f {
            *to += factor * term;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TIGHT: Tolerances = Tolerances { gradient: 1e-9, decrease: 1e-16, iterations: 500 };

    fn rosenbrock(x: &[f64], gradient: &mut [f64]) -> f64 {
        gradient.fill(0.0);
        let mut value = 0.0;
        for i in 0..x.len() - 1 {
            let (a, b) = (1.0 - x[i], x[i + 1] - x[i] * x[i]);
            value += a * a + 100.0 * b * b;
            gradient[i] += -2.0 * a - 400.0 * b * x[i];
            gradient[i + 1] += 200.0 * b;
        }
        value
    }

    #[test]
    fn the_minimum_of_a_curved_valley_is_found() {
        let minimum = minimise(rosenbrock, &[-1.2, 1.0], &[-5.0; 2], &[5.0; 2], TIGHT);
        assert!(minimum.value < 1e-14, "{minimum:?}");
        let minimum = minimise(rosenbrock, &[3.0; 6], &[-5.0; 6], &[5.0; 6], TIGHT);
        assert!(minimum.value < 1e-14, "{minimum:?}");
        assert!(minimum.point.iter().all(|x| (x - 1.0).abs() < 1e-6));
    }

    #[test]
    fn the_minimum_may_lie_at_a_bound() {
        // At the bound x[0] = 0.5 the descent direction points out of the box.
        let minimum = minimise(rosenbrock, &[-1.2, 0.4], &[-2.0; 2], &[0.5, 2.0], TIGHT);
        assert_eq!(minimum.point[0], 0.5);
        assert!((minimum.point[1] - 0.25).abs() < 1e-8);
    }

    #[test]
    fn a_step_to_a_value_that_is_not_finite_is_shortened() {
        let function = |x: &[f64], gradient: &mut [f64]| {
            gradient[0] = 1.0 - 1.0 / x[0];
            if x[0] > 0.0 { x[0] - x[0].ln() } else { f64::NAN }
        };
        let minimum = minimise(function, &[8.0], &[-10.0], &[10.0], TIGHT);
        assert!((minimum.point[0] - 1.0).abs() < 1e-7);
    }
}
