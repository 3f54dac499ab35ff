use std::path::Path;

use rustix::process::setpriority_process;
use rustix::thread::{CpuSet, sched_getaffinity, sched_setaffinity};

/// The logical processors on which trainings run while a control thread runs on this computer.
///
/// One core, with all its hardware threads, stays free of trainings if there is another core. The
/// control thread itself is not bound to that core: another user's program may be busy there, and
/// the kernel finds an idle core.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct TrainingCores(CpuSet);

/// The lowest priority of ordinary threads: even a control thread without real-time rights comes
/// first.
const LOWEST_PRIORITY: i32 = 19;

impl TrainingCores {
    /// All processors on which the calling thread may run, except the last core's processors. If
    /// there is no other core, only the last processor is left out, unless it is the only one.
    pub(super) fn beside_control_thread() -> Self {
        let all = Self::of_this_thread().unwrap_or(Self(CpuSet::new()));
        all.without_last_core(siblings)
    }

    /// The processors on which the calling thread may run; `None` where the operating system does
    /// not report them.
    pub(super) fn of_this_thread() -> Option<Self> {
        sched_getaffinity(None).ok().map(Self)
    }

    /// Number of processors, at least 1.
    pub(super) fn count(&self) -> usize {
        (self.0.count() as usize).max(1)
    }

    /// Keeps the calling thread to these processors, at the lowest priority. If the operating
    /// system refuses either, a warning is logged and the training goes on.
    pub(super) fn confine_this_thread(&self) {
        if self.0.count() > 0
            && let Err(error) = sched_setaffinity(None, &self.0)
        {
            tracing::warn!("trainings cannot be kept off the core for the control thread: {error}");
        }
        if let Err(error) = setpriority_process(None, LOWEST_PRIORITY) {
            tracing::warn!("trainings cannot have the lowest priority: {error}");
        }
    }

    /// Leaves out the last processor and the others of its core, or the last processor alone if
    /// there is no other core.
    fn without_last_core(self, siblings: impl Fn(usize) -> Vec<usize>) -> Self {
        let Some(last) = (0..CpuSet::MAX_CPU).rev().find(|&it| self.0.is_set(it)) else {
            return self;
        };
        let without = |left_out: &[usize]| {
            let mut set = self.0;
            left_out.iter().filter(|&&it| it < CpuSet::MAX_CPU).for_each(|&it| set.unset(it));
            (set.count() > 0).then_some(Self(set))
        };
        let mut core = siblings(last);
        core.push(last);
        without(&core).or_else(|| without(&[last])).unwrap_or(self)
    }
}

/// The logical processors of the core of `processor`; empty if Linux does not report them.
fn siblings(processor: usize) -> Vec<usize> {
    let path = format!("/sys/devices/system/cpu/cpu{processor}/topology/thread_siblings_list");
    let text = std::fs::read_to_string(Path::new(&path)).unwrap_or_default();
    parse_list(&text)
}

/// The numbers of a list such as `0,4-6`; skips parts that are not numbers.
fn parse_list(text: &str) -> Vec<usize> {
    let numbers = text.trim().split(',').filter_map(|part| {
        let (first, last) = part.split_once('-').unwrap_or((part, part));
        let (first, last): (usize, usize) = (first.parse().ok()?, last.parse().ok()?);
        Some(first..=last.min(CpuSet::MAX_CPU))
    });
    numbers.flatten().collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn set(processors: &[usize]) -> TrainingCores {
        let mut set = CpuSet::new();
        processors.iter().for_each(|&it| set.set(it));
        TrainingCores(set)
    }

    #[test]
    fn the_last_core_is_left_out_with_all_its_threads() {
        let alone = |_| Vec::new();
        assert_eq!(set(&[0, 1]).without_last_core(alone), set(&[0]));
        assert_eq!(set(&[0]).without_last_core(alone), set(&[0]), "there is no other processor");
        assert_eq!(set(&[]).without_last_core(alone), set(&[]));
        let pairs = |processor: usize| vec![processor % 4, processor % 4 + 4];
        let eight: Vec<usize> = (0..8).collect();
        assert_eq!(set(&eight).without_last_core(pairs), set(&[0, 1, 2, 4, 5, 6]));
        // If the process may run on one core only, the core's other hardware thread trains.
        assert_eq!(set(&[3, 7]).without_last_core(pairs), set(&[3]));
        assert_eq!(set(&[0]).count(), 1);
        assert_eq!(set(&[]).count(), 1);
    }

    #[test]
    fn lists_of_processors_are_read() {
        assert_eq!(parse_list("0,4\n"), [0, 4]);
        assert_eq!(parse_list("2-3,7"), [2, 3, 7]);
        assert_eq!(parse_list("3-1"), Vec::<usize>::new());
        assert_eq!(parse_list("none"), Vec::<usize>::new());
    }

    #[test]
    fn a_confined_thread_keeps_to_its_processors_and_others_do_not() {
        let before = TrainingCores::of_this_thread().unwrap();
        let cores = TrainingCores::beside_control_thread();
        let inside = std::thread::spawn(move || {
            cores.confine_this_thread();
            let priority = rustix::process::getpriority_process(None).unwrap();
            (TrainingCores::of_this_thread().unwrap(), priority)
        });
        assert_eq!(inside.join().unwrap(), (cores, LOWEST_PRIORITY));
        assert_eq!(TrainingCores::of_this_thread().unwrap(), before);
        assert!(cores.count() < before.count().max(2), "{cores:?} of {before:?}");
    }
}
