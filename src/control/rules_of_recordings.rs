//! Builds the parts of a tick by the rules that a recording names. A rollout that is driven names
//! the newest ones.

use super::rest::RestDetector;
use super::sensor_watch::SensorWatch;
use super::test_push::TestPush;
use super::watch::Watch;
use crate::safety::Brake;
use crate::telemetry::{TickRules, TickSettings};

/// The watch of link, timing and status flags, before its first sample.
pub(super) fn watch(rules: TickRules) -> Watch {
    if rules.compares_clocks() { Watch::default() } else { Watch::of_the_first_rules() }
}

/// The detector of rest before the policy, before its first state.
pub(super) fn rest_detector(settings: &TickSettings) -> RestDetector {
    if settings.rules.rests_by_encoders() {
        RestDetector::of(settings.plant.encoders)
    } else {
        RestDetector::default()
    }
}

/// The brake of a rollout whose arm has a count that can be trusted, before its first period.
pub(super) fn brake_of(settings: &TickSettings) -> Brake {
    if settings.safety_box.guard.is_box() {
        damping_brake(settings)
    } else {
        by_rules(Brake::centring(&settings.plant), settings.rules)
    }
}

/// The brake that uses the arm's velocity alone, before its first period.
pub(super) fn damping_brake(settings: &TickSettings) -> Brake {
    by_rules(Brake::stopping(&settings.plant), settings.rules)
}

fn by_rules(brake: Brake, rules: TickRules) -> Brake {
    if rules.reduces_gain_of_brake() { brake } else { brake.by_earlier_rules() }
}

/// The watch of the sensors, before its first sample.
pub(super) fn sensor_watch(settings: &TickSettings) -> SensorWatch {
    let watch = if settings.rules.cross_checks_encoders() {
        SensorWatch::with_cross_check(&settings.plant, settings.calibration)
    } else {
        SensorWatch::of(&settings.plant)
    };
    let watch = if settings.rules.tests_drift() { watch } else { watch.without_drift_test() };
    if settings.rules.allows_alternating() { watch } else { watch.by_earlier_rules() }
}

/// The test of an arm with a constant count; `None` under [`TickRules::First`].
pub(super) fn test_push(settings: &TickSettings) -> Option<TestPush> {
    let rules = settings.rules;
    let push = TestPush::of(&settings.plant);
    let push = if rules.allows_alternating() { push } else { push.by_earlier_rules() };
    rules.pushes_constant_arm().then_some(push)
}
