//! Tests the guard against policies that a search optimises to throw the arm against its stop.
//! `scripts/adversary` plays some 10^6 episodes, these tests a few thousand.

use qube_hil::qube::HARD_STOP_RAD;
use qube_hil::safety::SafetyBox;

use crate::adversary::episode::{Domain, PROMISED, play};
use crate::adversary::search::{Worst, search};

fn stays_short(worst: &Worst) {
    assert!(
        worst.episode.farthest_rad < HARD_STOP_RAD,
        "delays of seed {}, genes {:?}: {:?}",
        worst.seed,
        worst.genes,
        worst.episode
    );
}

#[test]
fn no_adversary_reaches_the_hard_stop_or_more_than_five_volts() {
    for seed in 1000..1003 {
        let worst = search(&PROMISED, seed, 12);
        println!(
            "search {seed}: {:.3} rad in {} episodes, {} of them ended by a fault",
            worst.episode.farthest_rad, worst.episodes, worst.false_faults
        );
        stays_short(&worst);
        assert_eq!(worst.largest_mv, 5000, "the clamp let more than 5 V through, or never 5 V");
    }
}

/// Tests that the search is effective: in the box alone, without foresight, two generations
/// suffice.
#[test]
fn in_the_box_alone_the_same_search_hits_at_once() {
    let domain = Domain { safety_box: SafetyBox::THESIS, ..PROMISED };
    let worst = search(&domain, 1, 2);
    assert!(worst.episode.farthest_rad > HARD_STOP_RAD, "{:?}", worst.episode);
}

#[test]
fn an_episode_repeats() {
    let worst = search(&PROMISED, 7, 1);
    let again = play(&worst.genes, &PROMISED, worst.seed);
    assert_eq!(again.farthest_rad.to_bits(), worst.episode.farthest_rad.to_bits());
    assert_eq!((again.ending, again.last_tick), (worst.episode.ending, worst.episode.last_tick));
}
