use std::fmt::Write;
use std::path::PathBuf;

use serde_json::{Value, json};

use super::exit::Failure;
use super::printable::one_line;
use super::{astray_line, quietness_line, timing_lines};
use crate::policy::Policy;
use crate::recording::read;
use crate::scoring::{Latencies, Quietness, Verdict, mean_return};
use crate::session::{Candidate, Purpose, Session, SessionError};
use crate::simulation::PsiSpace;

/// The table of a session: its candidates and the verified policies, read from its folder.
pub struct SessionTable {
    psi: PsiSpace,
    candidates: Vec<(Candidate, Vec<Verdict>)>,
    latencies: Latencies,
    /// Number of rollouts that a fault ended and that were repeated.
    void_rollouts: u64,
    /// Number of observer resets.
    observer_resets: u64,
    directory: String,
    /// Policy to use: the verified one with the highest mean return.
    best: Option<Best>,
}

struct Best {
    candidate: usize,
    policy: PathBuf,
    /// Quietness of its balancing.
    quietness: Quietness,
}

impl SessionTable {
    /// Reads ledger and recordings.
    pub fn read(session: &mut Session) -> Result<Self, SessionError> {
        let candidates = session.valued_candidates()?;
        let folder = session.folder();
        let mut latencies = Latencies::default();
        let (mut void_rollouts, mut observer_resets) = (0, 0);
        let mut best = best(&candidates).map(|candidate| Best {
            candidate,
            policy: folder.policy(candidate as u32),
            quietness: Quietness::NONE,
        });
        for (candidate, _) in &candidates {
            for &(rollout, attempt) in &candidate.finished {
                let recording = read(&folder.rollout(candidate.number, rollout, attempt))?;
                latencies.add(&recording.ticks);
                if let Some(best) = &mut best
                    && best.candidate == candidate.number as usize
                {
                    best.quietness.add(&recording.ticks);
                }
                void_rollouts += u64::from(attempt);
                observer_resets +=
                    recording.outcome.map_or(0, |outcome| u64::from(outcome.observer_resets));
            }
        }
        let directory = folder.root().display().to_string();
        let psi = session.settings().psi.clone();
        Ok(Self { psi, candidates, latencies, void_rollouts, observer_resets, directory, best })
    }

    /// Checks that the policy that is told as the best can be run.
    pub fn check_best_policy(&self) -> Result<(), Failure> {
        let Some(best) = &self.best else { return Ok(()) };
        Policy::load(&best.policy).map(drop).map_err(|error| {
            let told = one_line(&error.to_string()).into_owned();
            Failure::data_lost(format!("the best policy is lost: {told}"))
        })
    }

    /// The table for people, 80 columns wide.
    pub fn text(&self) -> String {
        let mut text =
            String::from("\n   #  purpose   mean return  rollouts  psi in its box, 0 to 9\n");
        for (candidate, verdicts) in &self.candidates {
            let purpose = match candidate.purpose {
                Purpose::Initial => "initial".into(),
                Purpose::Search => "search".into(),
                Purpose::Verification => "answer".into(),
                Purpose::Incumbent => format!("{} again", self.incumbent(candidate)),
            };
            let mean = match mean_return(verdicts) {
                Some(mean) => format!("{mean:11.1}"),
                None => format!("{:>11}", "-"),
            };
            let successes = verdicts.iter().filter(|verdict| verdict.is_success()).count();
            let _ = writeln!(
                text,
                "{:4}  {purpose:8} {mean}  {successes:2} of {:<2}  {}",
                candidate.number,
                verdicts.len(),
                digits(&self.psi, &candidate.psi),
            );
        }
        let _ = writeln!(text, "      psi: {}", self.psi.names().collect::<Vec<_>>().join(" "));
        if let Some(Best { candidate, policy, quietness }) = &self.best {
            let (candidate, verdicts) = &self.candidates[*candidate];
            let whose = match candidate.purpose {
                Purpose::Incumbent => format!("that of candidate {}", self.incumbent(candidate)),
                _ => "that of the search's recommendation".into(),
            };
            let successes = verdicts.iter().filter(|verdict| verdict.is_success()).count();
            let _ = writeln!(
                text,
                "\nbest policy: {}\n{whose}: mean return {:.1} over {} rollouts, {successes} of \
                 them balance",
                policy.display(),
                mean_return(verdicts).unwrap_or(0.0),
                verdicts.len(),
            );
            text.push_str(&quietness_line(quietness));
            let longest = self.psi.names().map(|name| name.len()).max().unwrap_or(0);
            for (dimension, value) in self.psi.dimensions().iter().zip(&candidate.psi) {
                let (name, unit) = (dimension.target.to_string(), dimension.target.unit());
                let _ = writeln!(text, "  {name:longest$}  {value:.5} {unit}");
            }
        }
        if self.void_rollouts > 0 {
            let void = self.void_rollouts;
            let _ =
                writeln!(text, "rollouts that a fault made void and that were repeated: {void}");
        }
        text.push_str(&astray_line(self.observer_resets));
        text.push_str(&timing_lines(&self.latencies));
        let _ = writeln!(text, "everything is in {}", self.directory);
        text.push_str("qube-hil session --help explains the words of this table\n");
        text
    }

    /// The searched candidate whose policy this one runs again; they share their psi.
    fn incumbent(&self, again: &Candidate) -> u32 {
        let is_same = |it: &&Candidate| it.purpose.is_searched() && it.psi == again.psi;
        let mut candidates = self.candidates.iter().map(|(candidate, _)| candidate);
        candidates.find(is_same).unwrap_or(again).number
    }

    /// The table as JSON, for scripts; the caller adds the elapsed time.
    pub fn json(&self) -> Value {
        let all = |purposes: &dyn Fn(Purpose) -> bool| {
            let chosen = self.candidates.iter().filter(|(it, _)| purposes(it.purpose));
            chosen
                .map(|(candidate, verdicts)| valued(&self.psi, candidate, verdicts))
                .collect::<Vec<Value>>()
        };
        let best = self.best.as_ref().map(|Best { candidate, policy, quietness }| {
            let (candidate, verdicts) = &self.candidates[*candidate];
            let mut best = valued(&self.psi, candidate, verdicts);
            best["policy"] = json!(policy.to_string_lossy());
            best["balancing"] = json!(quietness.figures());
            best
        });
        let rollouts: usize = self.candidates.iter().map(|(_, verdicts)| verdicts.len()).sum();
        json!({
            "candidates": all(&Purpose::is_searched),
            "verified": all(&|purpose| !purpose.is_searched()),
            "best": best,
            "rollouts": rollouts,
            "void_rollouts": self.void_rollouts,
            "times_astray": self.observer_resets,
            "missed_deadlines": self.latencies.missed_deadlines(),
            "lateness_us": self.latencies.lateness_us(),
            "sample_to_act_us": self.latencies.sample_to_act_us(),
            "directory": self.directory,
        })
    }
}

fn valued(psi: &PsiSpace, candidate: &Candidate, verdicts: &[Verdict]) -> Value {
    let returns: Vec<f64> = verdicts.iter().filter_map(Verdict::return_).collect();
    json!({
        "candidate": candidate.number,
        "purpose": candidate.purpose,
        "psi": psi.with_names(&candidate.psi),
        "returns": returns,
        "mean_return": mean_return(verdicts),
    })
}

/// The verified candidate with the highest mean return; the recommendation in a tie.
fn best(candidates: &[(Candidate, Vec<Verdict>)]) -> Option<usize> {
    let mut best: Option<(usize, f64)> = None;
    for (index, (candidate, verdicts)) in candidates.iter().enumerate() {
        let Some(mean) = mean_return(verdicts).filter(|_| !candidate.purpose.is_searched()) else {
            continue;
        };
        if best.is_none_or(|(_, so_far)| mean > so_far) {
            best = Some((index, mean));
        }
    }
    best.map(|(index, _)| index)
}

/// Position of each entry of psi within its box, as a digit.
fn digits(space: &PsiSpace, psi: &[f64]) -> String {
    space
        .dimensions()
        .iter()
        .zip(psi)
        .map(|(dimension, value)| {
            let place = (value - dimension.lower) / (dimension.upper - dimension.lower);
            ((place * 10.0) as u32).min(9).to_string()
        })
        .collect::<Vec<_>>()
        .join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_went_astray_is_told_where_anything_has() {
        let quiet = SessionTable {
            psi: PsiSpace::default(),
            candidates: Vec::new(),
            latencies: Latencies::default(),
            void_rollouts: 0,
            observer_resets: 0,
            directory: "logs/one".into(),
            best: None,
        };
        let text = quiet.text();
        assert!(!text.contains("void") && !text.contains("observer"), "{text}");
        let text = SessionTable { void_rollouts: 3, observer_resets: 7, ..quiet }.text();
        assert!(text.contains("were repeated: 3\n"), "{text}");
        assert!(text.contains("observer diverged 7 times"), "{text}");
    }
}
