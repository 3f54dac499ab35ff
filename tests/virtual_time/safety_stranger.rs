//! Tests foresight against an adversary that knows only the promise of foresight, in a search small
//! enough for every run of the tests.
//!
//! `cargo run --release --example strangers_adversary` searches at full size. The search of these
//! tests has no mishaps on the link. Three episodes with lost samples, in which the arm reaches its
//! stop if parts of foresight are switched off, are repeated.

use qube_hil::safety::Guard;
use qube_hil::telemetry::TickRules;
use serde::Deserialize;

use crate::stranger::{
    AdversarySearch, BeliefKind, Effort, Method, Scenario, SearchRecord, summary,
};

/// Extent of the searches: far fewer episodes than in the example.
const EFFORT: Effort = Effort { generations: 3, population: 16 };

/// A seed whose attack is linear feedback in three stages on a link without mishaps; the Qube is
/// searched too.
const SEED: u64 = 7;

/// The search of that seed on an identified Qube.
fn search(method: Method, guard: Guard) -> AdversarySearch {
    AdversarySearch { seed: SEED, known: BeliefKind::Identified, method, guard }
}

#[test]
fn no_arm_of_an_identified_qube_reaches_its_stop() {
    for method in [Method::Ce, Method::Cma] {
        let record = search(method, Guard::Foresight).run(EFFORT);
        let told = serde_json::to_string(&record.kept_hits).unwrap();
        assert_eq!(record.hits, 0, "{method:?} reached {} rad: {told}", record.farthest_rad);
        assert!(record.farthest_rad > 0.5, "{method:?} only went to {} rad", record.farthest_rad);
    }
}

#[test]
fn without_foresight_the_same_searches_reach_the_stop() {
    for method in [Method::Ce, Method::Cma] {
        let record = search(method, Guard::Box).run(EFFORT);
        assert!(record.hits > 0, "{method:?} only went to {} rad", record.farthest_rad);
    }
}

#[test]
fn an_episode_repeats_bit_for_bit() {
    let search = search(Method::Cma, Guard::Foresight);
    let record = search.run(EFFORT);
    let text = serde_json::to_string(&record).unwrap();
    assert_eq!(serde_json::to_string(&search.run(EFFORT)).unwrap(), text);
    let read: SearchRecord = serde_json::from_str(&text).unwrap();
    let farthest = read.farthest.unwrap();
    let trace = search.show(&read.scenario, &farthest.genes);
    assert_eq!(trace.outcome, farthest.outcome);
    assert!(trace.lines.len() > 30 && trace.told.contains("zero off by"));
    assert!(summary(&[record]).contains("48 episodes"));
}

/// An episode that a search has found.
#[derive(Deserialize)]
struct Episode {
    scenario: Scenario,
    genes: Vec<f64>,
}

/// Reads an episode; returns it with a search on the same Qube under foresight.
fn episode(text: &str) -> (AdversarySearch, Episode) {
    let episode: Episode = serde_json::from_str(text).unwrap();
    let Scenario { seed, known, .. } = episode.scenario;
    let guard = Guard::Foresight;
    (AdversarySearch { seed, known, method: Method::Ce, guard }, episode)
}

/// Three samples are lost twice within 0.1 s while the brake rings on the strongest motor with the
/// lightest arm.
#[test]
fn samples_that_are_lost_twice_while_the_brake_rings_do_not_throw_the_arm_into_its_stop() {
    let (search, Episode { scenario, genes }) =
        episode(include_str!("../fixtures/samples_lost_twice_while_the_brake_rings.json"));
    let untried = search.play_by(&scenario, &genes, |settings| {
        settings.rules = TickRules::GainReducing;
        settings.foresight.as_mut().unwrap().velocity_error_power = 0;
    });
    assert!(untried.is_hit(), "a brake whose voltages are not tried: {untried:?}");
    let tried = search.play_by(&scenario, &genes, |_| ());
    assert!(!tried.is_hit() && tried.farthest_rad < 2.2, "{tried:?}");
}

/// Three samples are lost twice within 70 ms while the pendulum spins. The one velocity between the
/// losses is a mean over 40 ms, in which the arm's velocity changes by 9 rad/s.
#[test]
fn samples_that_are_lost_twice_while_the_pendulum_spins_do_not_throw_the_arm_into_its_stop() {
    let (search, Episode { scenario, genes }) =
        episode(include_str!("../fixtures/samples_lost_twice_while_the_pendulum_spins.json"));
    let certain = search.play_by(&scenario, &genes, |settings| {
        settings.foresight.as_mut().unwrap().velocity_error_power = 0;
    });
    assert!(certain.is_hit(), "a velocity that counts as certain as any: {certain:?}");
    let uncertain = search.play_by(&scenario, &genes, |_| ());
    assert!(!uncertain.is_hit() && uncertain.farthest_rad < 2.2, "{uncertain:?}");
}

/// Three samples are lost as the arm moves outward at 11.5 rad/s on a Qube whose amplifier gives
/// 80 % of the voltages that brake it. The arm is stopped, and its pendulum draws it out once more.
#[test]
fn three_samples_lost_before_a_weak_side_brakes_do_not_throw_the_arm_into_its_stop() {
    let (search, Episode { scenario, genes }) =
        episode(include_str!("../fixtures/three_samples_lost_before_a_weak_side_brakes.json"));
    let whole = search.play_by(&scenario, &genes, |settings| {
        let foresight = settings.foresight.as_mut().unwrap();
        foresight.identified.as_mut().unwrap().belief.weak_side = false;
    });
    assert!(whole.is_hit(), "particles that all get whole voltages: {whole:?}");
    let weak = search.play_by(&scenario, &genes, |_| ());
    assert!(!weak.is_hit() && weak.farthest_rad < 2.2, "{weak:?}");
}
