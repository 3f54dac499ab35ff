use std::fmt::Write;

use serde_json::{Value, json};

use super::timing_lines;
use crate::recording::read;
use crate::session::{Candidate, Latencies, Purpose, Session, SessionError, Verdict};
use crate::simulation::PsiSpace;

/// The end of a session: its candidates and the verified answer, read from its folder.
pub struct SessionTable {
    psi: PsiSpace,
    candidates: Vec<(Candidate, Vec<Verdict>)>,
    latencies: Latencies,
    directory: String,
    best_policy: Option<String>,
}

impl SessionTable {
    /// Reads ledger and recordings.
    pub fn read(session: &mut Session) -> Result<Self, SessionError> {
        let candidates = session.valued_candidates()?;
        let folder = session.folder();
        let mut latencies = Latencies::default();
        for (candidate, _) in &candidates {
            for &(rollout, attempt) in &candidate.finished {
                let path = folder.rollout(candidate.number, rollout, attempt);
                latencies.add(&read(&path)?.ticks);
            }
        }
        let best_policy = verified(&candidates)
            .map(|(candidate, _)| folder.policy(candidate.number).display().to_string());
        let directory = folder.root().display().to_string();
        let psi = session.settings().psi.clone();
        Ok(Self { psi, candidates, latencies, directory, best_policy })
    }

    /// For people, 80 columns wide.
    pub fn text(&self) -> String {
        let mut text =
            String::from("\n   #  purpose   mean return  rollouts  psi in its box, 0 to 9\n");
        for (candidate, verdicts) in &self.candidates {
            let purpose = match candidate.purpose {
                Purpose::Initial => "initial",
                Purpose::Search => "search",
                Purpose::Verification => "answer",
            };
            let mean = match mean_return(verdicts) {
                Some(mean) => format!("{mean:11.1}"),
                None => format!("{:>11}", "-"),
            };
            let stood = verdicts.iter().filter(|verdict| succeeded(verdict)).count();
            let _ = writeln!(
                text,
                "{:4}  {purpose:8} {mean}  {stood:2} of {:<2}  {}",
                candidate.number,
                verdicts.len(),
                digits(&self.psi, &candidate.psi),
            );
        }
        let _ = writeln!(text, "      psi: {}", self.psi.names().collect::<Vec<_>>().join(" "));
        if let (Some((candidate, verdicts)), Some(policy)) =
            (verified(&self.candidates), &self.best_policy)
        {
            let returns: Vec<f64> = verdicts.iter().filter_map(Verdict::return_).collect();
            let stood = verdicts.iter().filter(|verdict| succeeded(verdict)).count();
            let _ = writeln!(
                text,
                "\nverified answer: mean return {:.1} over {} rollouts, {stood} of them stand",
                mean_return(verdicts).unwrap_or(0.0),
                returns.len(),
            );
            let longest = self.psi.names().map(|name| name.len()).max().unwrap_or(0);
            for (name, value) in self.psi.names().zip(&candidate.psi) {
                let _ = writeln!(text, "  {name:longest$}  {value:.5}");
            }
            let _ = writeln!(text, "policy: {policy}");
        }
        text.push_str(&timing_lines(&self.latencies));
        let _ = writeln!(text, "everything is in {}", self.directory);
        text
    }

    /// For scripts; the caller adds how long it took.
    pub fn json(&self) -> Value {
        let searched = self
            .candidates
            .iter()
            .filter(|(candidate, _)| candidate.purpose != Purpose::Verification)
            .map(|(candidate, verdicts)| valued(&self.psi, candidate, verdicts))
            .collect::<Vec<Value>>();
        let best = verified(&self.candidates).map(|(candidate, verdicts)| {
            let mut best = valued(&self.psi, candidate, verdicts);
            best["policy"] = json!(self.best_policy);
            best
        });
        let rollouts: usize = self.candidates.iter().map(|(_, verdicts)| verdicts.len()).sum();
        json!({
            "candidates": searched,
            "best": best,
            "rollouts": rollouts,
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
        "psi": psi.with_names(&candidate.psi),
        "returns": returns,
        "mean_return": mean_return(verdicts),
    })
}

fn verified(candidates: &[(Candidate, Vec<Verdict>)]) -> Option<&(Candidate, Vec<Verdict>)> {
    candidates.iter().find(|(candidate, verdicts)| {
        candidate.purpose == Purpose::Verification && !verdicts.is_empty()
    })
}

fn mean_return(verdicts: &[Verdict]) -> Option<f64> {
    let returns: Vec<f64> = verdicts.iter().filter_map(Verdict::return_).collect();
    (!returns.is_empty()).then(|| returns.iter().sum::<f64>() / returns.len() as f64)
}

fn succeeded(verdict: &Verdict) -> bool {
    matches!(verdict, Verdict::Result { success: true, .. })
}

/// Where each entry of psi lies between the ends of its box, as a digit.
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
