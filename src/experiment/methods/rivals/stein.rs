use nalgebra::DVector;

/// The particles after one step of Stein variational gradient descent (Liu and Wang 2016). Each
/// particle follows the mean of all particles' gradients, weighted by their nearness, and is pushed
/// away from the other particles. `gradients` has the gradient of the log density at each particle.
pub fn stein_step(
    particles: &[DVector<f64>],
    gradients: &[DVector<f64>],
    rate: f64,
) -> Vec<DVector<f64>> {
    let count = particles.len() as f64;
    let bandwidth = bandwidth_of(particles);
    particles
        .iter()
        .map(|own| {
            let mut step = DVector::zeros(own.len());
            for (other, gradient) in particles.iter().zip(gradients) {
                let between = own - other;
                let near = (-between.norm_squared() / bandwidth).exp();
                step += near * (gradient + between * (2.0 / bandwidth));
            }
            own + (rate / count) * step
        })
        .collect()
}

/// Bandwidth of the kernel: the squared median distance over the logarithm of one more than the
/// number of particles. As with the paper's bandwidth, the neighbours of a particle together weigh
/// about as much as the particle itself.
fn bandwidth_of(particles: &[DVector<f64>]) -> f64 {
    let mut squares: Vec<f64> = particles
        .iter()
        .enumerate()
        .flat_map(|(index, one)| particles[..index].iter().map(move |it| (one - it).norm_squared()))
        .collect();
    squares.sort_by(f64::total_cmp);
    let median = squares.get(squares.len() / 2).copied().unwrap_or(1.0);
    (median / ((particles.len() + 1) as f64).ln()).max(1e-9)
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng as _;
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::experiment::methods::rivals::gaussian::Gaussian;

    #[test]
    fn particles_arrive_at_a_known_normal_distribution() {
        let mut particles = Gaussian::standard(2).draws(60, &mut ChaCha8Rng::seed_from_u64(3));
        let (centre, variance) = (DVector::from_vec(vec![2.0, -1.0]), 0.36);
        for _ in 0..1500 {
            let gradients: Vec<_> = particles.iter().map(|it| (&centre - it) / variance).collect();
            particles = stein_step(&particles, &gradients, 0.05);
        }
        let found = Gaussian::of_points(&particles, &[1.0; 60]);
        assert!((&found.mean - centre).norm() < 0.05, "{}", found.mean);
        for entry in 0..2 {
            let part = found.covariance[(entry, entry)] / variance;
            assert!((0.7..1.2).contains(&part), "{}", found.covariance);
        }
    }
}
