//! Figures of the densities of simulated quantities, and the names of the quantities in words.

use super::chart::{Axis, Chart, Mark, Series, Style};
use crate::qube::{Distribution, DomainParameter, Quantity};

/// The masses and lengths of the thesis's figure 5.2; reports draw them before the others.
pub const FIRST: [DomainParameter; 4] = [
    DomainParameter::RotaryMass,
    DomainParameter::PendulumMass,
    DomainParameter::RotaryLength,
    DomainParameter::PendulumLength,
];

/// Largest standard deviation, in a quantity's SI unit, of a quantity that counts as constant; nobody
/// knows one that precisely. Tables show numbers below it as 0.
pub const NEGLIGIBLE: f64 = 1e-12;

/// Number of points over the range of the figure, and again over the range of each density.
const PLACES: usize = 121;

/// Whether a distribution has a density to draw. The limit is above 0 because of fits: for a
/// quantity that no recording shows, such as the rest angle of a cable without stiffness, rounding
/// alone may leave a deviation.
pub fn has_spread(distribution: &Distribution) -> bool {
    distribution.standard_deviation() > NEGLIGIBLE && distribution.mean().is_finite()
}

/// A figure of named densities of a quantity, without those that have no spread. It reaches at least
/// 3.5 standard deviations to both sides of each mean. A line marks the nominal value.
pub fn density_chart(quantity: Quantity, curves: &[(&str, Distribution)], nominal: f64) -> Chart {
    let spread = || {
        let named = curves.iter().enumerate();
        named.filter(|(_, (_, it))| has_spread(it))
    };
    let ends = |it: &Distribution| {
        let reach = 3.5 * it.standard_deviation();
        [it.mean() - reach, it.mean() + reach]
    };
    let all = || spread().flat_map(|(_, (_, it))| ends(it)).chain([nominal]);
    let (low, high) =
        (all().fold(f64::INFINITY, f64::min), all().fold(f64::NEG_INFINITY, f64::max));
    let margin = 0.03 * (high - low);
    let (low, high) = (low - margin, high + margin);
    let between = |from: f64, to: f64| {
        (0..PLACES).map(move |index| from + (to - from) * index as f64 / (PLACES - 1) as f64)
    };
    // A narrow density needs points of its own, because those of the whole range may miss it.
    let own = spread().flat_map(|(_, (_, it))| {
        let [from, to] = ends(it);
        between(from, to)
    });
    let mut xs: Vec<f64> = between(low, high).chain(own).collect();
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
    use crate::qube::Nonideality as G;
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
        Quantity::Nonideality(G::CoulombTorque) => "arm's dry friction",
        Quantity::Nonideality(G::PositiveDeadZone) => "dead zone of positive voltages",
        Quantity::Nonideality(G::NegativeDeadZone) => "dead zone of negative voltages",
        Quantity::Nonideality(G::CableStiffness) => "cable's stiffness",
        Quantity::Nonideality(G::CableRest) => "cable's rest angle",
        Quantity::Nonideality(G::CommandDelay) => "delay of a command",
    };
    match quantity {
        Quantity::Parameter(_) => format!("{name}, {}", quantity.symbol()),
        Quantity::Nonideality(_) => name.to_owned(),
    }
}
