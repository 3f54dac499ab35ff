//! Figures of the densities of simulated quantities, and the names of the quantities in words.

use super::chart::{Axis, Chart, Mark, Series, Style};
use super::draws::QuantityDraws;
use crate::qube::{DomainParameter, Quantity};

/// Number of points over the range of the figure, and again over the range of each density.
const PLACES: usize = 121;

/// Returns the figure of the named draws of a quantity. Draws without spread are not in the figure.
/// The horizontal axis reaches no value that no draw can have, except the nominal value, which a
/// line marks.
pub fn density_chart(quantity: Quantity, curves: &[(&str, &QuantityDraws)], nominal: f64) -> Chart {
    let spread = || {
        let named = curves.iter().enumerate();
        named.filter(|(_, (_, it))| it.has_spread())
    };
    let smallest = |of: fn(&QuantityDraws) -> f64| {
        spread().map(|(_, (_, it))| of(it)).chain([nominal]).fold(f64::INFINITY, f64::min)
    };
    let largest = |of: fn(&QuantityDraws) -> f64| {
        spread().map(|(_, (_, it))| of(it)).chain([nominal]).fold(f64::NEG_INFINITY, f64::max)
    };
    let (low, high) = (smallest(|it| it.drawn.0), largest(|it| it.drawn.1));
    let margin = 0.03 * (high - low);
    let low = (low - margin).max(smallest(|it| it.range.0));
    let high = (high + margin).min(largest(|it| it.range.1));
    let between = |from: f64, to: f64| {
        (0..PLACES).map(move |index| from + (to - from) * index as f64 / (PLACES - 1) as f64)
    };
    // A narrow density needs points of its own, because the points of the whole range may miss it;
    // the points just outside it let the curve fall to 0 at its ends.
    let own = spread().flat_map(|(_, (_, it))| {
        let (from, to) = it.drawn;
        between(from, to).chain([from.next_down(), to.next_up()])
    });
    let mut xs: Vec<f64> = between(low, high).chain(own).collect();
    xs.retain(|x| (low..=high).contains(x));
    xs.sort_by(f64::total_cmp);
    let series = spread().map(|(index, (name, it))| {
        let style = if index == 0 { Style::Line } else { Style::Dashed };
        Series::new(*name, style, index, xs.iter().map(|&x| Some(it.density(x))))
    });
    let unit = quantity.unit();
    Chart {
        x: Axis::new(words(quantity), unit),
        y: Axis::new("density", &per(unit)),
        series: series.collect(),
        marks: vec![Mark::vertical(nominal, "nominal")],
        x_range: Some([low, high]),
        height: Some(210),
        xs,
        ..Chart::default()
    }
}

/// The unit of the density of a quantity with this unit.
fn per(unit: &str) -> String {
    if unit.contains([' ', '/']) { format!("1/({unit})") } else { format!("1/{unit}") }
}

/// Name of a quantity in words; a parameter has its symbol too.
pub fn words(quantity: Quantity) -> String {
    use crate::qube::Nonideality as N;
    use DomainParameter as P;
    let name = match quantity {
        Quantity::Parameter(P::Gravity) => "gravity",
        Quantity::Parameter(P::MotorResistance) => "motor's resistance",
        Quantity::Parameter(P::MotorBackEmf) => "motor's back EMF",
        Quantity::Parameter(P::RotaryDamping) => "arm's damping",
        Quantity::Parameter(P::PendulumDamping) => "pendulum's damping",
        Quantity::Parameter(P::RotaryMass) => "arm's mass",
        Quantity::Parameter(P::PendulumMass) => "pendulum's mass",
        Quantity::Parameter(P::RotaryLength) => "arm's length",
        Quantity::Parameter(P::PendulumLength) => "pendulum's length",
        Quantity::Nonideality(N::CoulombTorque) => "arm's dry friction",
        Quantity::Nonideality(N::PositiveDeadZone) => "dead zone of positive voltages",
        Quantity::Nonideality(N::NegativeDeadZone) => "dead zone of negative voltages",
        Quantity::Nonideality(N::CableStiffness) => "cable's stiffness",
        Quantity::Nonideality(N::CableRest) => "cable's rest angle",
        Quantity::Nonideality(N::CommandDelay) => "delay of a command",
    };
    match quantity {
        Quantity::Parameter(_) => format!("{name}, {}", quantity.symbol()),
        Quantity::Nonideality(_) => name.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::{Nonideality, PlantModel};
    use crate::simulation::{Direction, DomainDistribution};

    #[test]
    fn a_figure_reaches_no_impossible_value() {
        let friction = Quantity::Nonideality(Nonideality::CoulombTorque);
        let error = Direction::new(&[(friction, 1e-4)]);
        let draws = QuantityDraws::of(&DomainDistribution::nominal().along(&[error]));
        let nominal = PlantModel::QUBE.nominal().get(friction);
        let curves = [("in its training", &draws[friction.index()])];
        let chart = density_chart(friction, &curves, nominal);
        let [low, high] = chart.x_range.unwrap();
        assert!(low == 0.0 && high > 3e-4, "{low} to {high}");
        assert!(chart.xs.iter().all(|x| *x >= 0.0));
    }
}
