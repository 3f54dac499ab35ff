use std::f64::consts::TAU;

/// Converts two independent numbers that are uniform in [0, 1) to two independent numbers from N(0,
/// 1), by the transform of Box and Muller (1958).
#[must_use]
pub fn normal_pair([first, second]: [f64; 2]) -> [f64; 2] {
    // `1 - first` is never 0, whose logarithm is infinite.
    let radius = libm::sqrt(-2.0 * libm::log(1.0 - first));
    let (sin, cos) = libm::sincos(TAU * second);
    [radius * cos, radius * sin]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_pair_is_finite_and_a_grid_of_pairs_has_the_moments_of_the_normal_distribution() {
        let grid = |i: u32| (f64::from(i) + 0.5) / 1000.0;
        let pairs = (0..1000).flat_map(|i| (0..1000).map(move |j| [grid(i), grid(j)]));
        let (mut squares, mut fourths, mut products) = (0.0, 0.0, 0.0);
        for [one, other] in pairs.map(normal_pair) {
            squares += one.powi(2);
            fourths += one.powi(4);
            products += one * other;
        }
        assert!((squares / 1e6 - 1.0).abs() < 1e-3, "{squares}");
        assert!((fourths / 1e6 - 3.0).abs() < 3e-2, "{fourths}");
        assert!((products / 1e6).abs() < 1e-9, "{products}");
        let largest_below_one = 1.0 - f64::EPSILON / 2.0;
        for uniform in [[0.0, 0.0], [largest_below_one, largest_below_one]] {
            assert!(normal_pair(uniform).iter().all(|draw| draw.abs() < 9.0));
        }
    }
}
