//! Tests whether this computer can drive a Qube at 100 Hz. The tests leave no change behind.

mod panel;
mod ports;
mod processor;
mod timer;

pub use ports::may_be_serial;

use std::sync::atomic::AtomicBool;

use serde::Serialize;

use crate::clock::{CPU_DMA_LATENCY, RealtimeRefusals};
use crate::device::HilAddress;
use crate::preflight::foresight_time_us;
use crate::qube::PlantModel;

/// The result of one test of the computer.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Diagnosis {
    /// Name of the test.
    pub name: String,
    /// Verdict of the test.
    pub verdict: Suitability,
    /// Finding, in a few words.
    pub value: String,
    /// Command or action that helps; `None` if all is well.
    pub remedy: Option<String>,
}

/// The verdict about one property of the computer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Suitability {
    /// The property is as it should be.
    Well,
    /// The property is sufficient, but could be better.
    Advice,
    /// The property is insufficient.
    Unfit,
}

impl Diagnosis {
    fn well(name: &str, value: impl Into<String>) -> Self {
        Self { name: name.into(), verdict: Suitability::Well, value: value.into(), remedy: None }
    }

    fn advice(name: &str, value: impl Into<String>, remedy: impl Into<String>) -> Self {
        let remedy = Some(remedy.into());
        Self { name: name.into(), verdict: Suitability::Advice, value: value.into(), remedy }
    }

    fn unfit(name: &str, value: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self { verdict: Suitability::Unfit, ..Self::advice(name, value, remedy) }
    }
}

/// Runs all tests of the computer. The test of the timer takes `seconds`, or less if `stop` is set.
/// `ports` are the serial ports to test; if it is empty, all USB serial ports are tested. An
/// address of the vendor's library among them names a card, which is greeted and sampled; nothing
/// moves. If `ports` names only cards, no serial port is tested.
///
/// # Errors
/// The operating system cannot start a thread.
pub fn diagnose(
    ports: &[String],
    seconds: u32,
    stop: &AtomicBool,
) -> std::io::Result<Vec<Diagnosis>> {
    let (realtime, jitter) = timer::watch(seconds, stop)?;
    let mut found = rights(&realtime);
    found.push(jitter);
    found.push(processor::governor());
    found.push(processor::foresight(foresight_time_us(&PlantModel::QUBE)));
    let (cards, serial): (Vec<_>, Vec<_>) =
        ports.iter().cloned().partition(|port| HilAddress::is_meant(port));
    if cards.is_empty() || !serial.is_empty() {
        found.extend(ports::diagnose(&serial));
    }
    found.extend(panel::diagnose(&cards, stop));
    Ok(found)
}

/// The command that gives an ordinary user the real-time rights, once: the group `realtime` and its
/// limits.
const RIGHTS_REMEDY: &str = "sudo scripts/install (then log out and in)";

fn rights(realtime: &RealtimeRefusals) -> Vec<Diagnosis> {
    let scheduling = match &realtime.scheduling {
        None => Diagnosis::well("scheduling", "real-time priority (SCHED_FIFO) is granted"),
        Some(_) => Diagnosis::advice(
            "scheduling",
            "no right to real-time priority: on a busy computer ticks will be late",
            RIGHTS_REMEDY,
        ),
    };
    let memory = match &realtime.memory {
        None => Diagnosis::well("memory", "memory can be locked"),
        Some(_) => Diagnosis::advice(
            "memory",
            "memory cannot be locked: a page fault may delay a tick",
            RIGHTS_REMEDY,
        ),
    };
    let awake = match &realtime.awake {
        None => Diagnosis::well("sleep", "processors can be kept awake between ticks"),
        Some(_) => Diagnosis::advice(
            "sleep",
            format!("{CPU_DMA_LATENCY} may not be written: processors may sleep between ticks"),
            RIGHTS_REMEDY,
        ),
    };
    let timer_slack = realtime.timer_slack.as_ref().map(|_| {
        Diagnosis::advice(
            "timer slack",
            "cannot be set: without real-time priority ticks are 0.05 ms late",
            "allow the system call prctl(PR_SET_TIMERSLACK), which a container may forbid",
        )
    });
    [scheduling, memory, awake].into_iter().chain(timer_slack).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn missing_rights_give_advice_with_a_remedy() {
        let no = Some("no".to_owned());
        let refused = RealtimeRefusals {
            scheduling: no.clone(),
            memory: no.clone(),
            awake: no.clone(),
            timer_slack: no,
        };
        assert_eq!(rights(&refused).len(), refused.refusals().count());
        for diagnosis in rights(&refused) {
            assert_eq!(diagnosis.verdict, Suitability::Advice);
            let way = if diagnosis.name == "timer slack" { "PR_SET_TIMERSLACK" } else { "sudo" };
            assert!(diagnosis.remedy.unwrap().contains(way));
        }
        for diagnosis in rights(&RealtimeRefusals::default()) {
            assert_eq!((diagnosis.verdict, diagnosis.remedy), (Suitability::Well, None));
        }
    }
}
