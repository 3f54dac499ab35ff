use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

use super::Diagnosis;
use crate::preflight::{SLOW_US, TOO_SLOW_US};

const NAME: &str = "processor";

const FORESIGHT: &str = "foresight";

/// Folder in which Linux shows its processors.
const PROCESSORS: &str = "/sys/devices/system/cpu";

/// Tests the governor, the rule by which Linux chooses a processor's clock rate: a processor that
/// saves power wakes up late.
pub(super) fn governor() -> Diagnosis {
    diagnosis(&governors(Path::new(PROCESSORS)))
}

/// The diagnosis of the time that the longest prediction of the guard takes on this processor, us.
pub(super) fn foresight(longest_us: f64) -> Diagnosis {
    let value =
        format!("the guard's longest prediction takes {longest_us:.0} us of a tick's 10 ms");
    if longest_us <= SLOW_US {
        return Diagnosis::well(FORESIGHT, value);
    }
    let remedy = "use a processor with AVX2 or AVX-512, and run nothing else on it";
    if longest_us <= TOO_SLOW_US {
        return Diagnosis::advice(FORESIGHT, value, remedy);
    }
    let refused = format!("{value}: more than {TOO_SLOW_US:.0} us is refused on a real Qube");
    Diagnosis::unfit(FORESIGHT, refused, remedy)
}

fn governors(processors: &Path) -> BTreeSet<String> {
    let Ok(entries) = fs::read_dir(processors) else { return BTreeSet::new() };
    entries
        .flatten()
        .filter_map(|entry| fs::read_to_string(entry.path().join("cpufreq/scaling_governor")).ok())
        .map(|governor| governor.trim().to_owned())
        .collect()
}

fn diagnosis(governors: &BTreeSet<String>) -> Diagnosis {
    let named = governors.iter().cloned().collect::<Vec<_>>().join(", ");
    if governors.is_empty() {
        return Diagnosis::well(NAME, "its governor cannot be read here (a virtual machine?)");
    }
    if named == "performance" {
        return Diagnosis::well(NAME, "governor performance");
    }
    Diagnosis::advice(
        NAME,
        format!("governor {named}: the processor may sleep deeply between ticks"),
        "sudo cpupower frequency-set -g performance (until the next start)",
    )
}

#[cfg(test)]
mod tests {
    use super::super::Suitability;
    use super::*;

    #[test]
    fn a_processor_that_predicts_slowly_is_named() {
        for (longest_us, verdict) in
            [(90.0, Suitability::Well), (900.0, Suitability::Advice), (4500.0, Suitability::Unfit)]
        {
            let diagnosis = foresight(longest_us);
            assert_eq!(diagnosis.verdict, verdict);
            assert!(diagnosis.value.contains(&format!("{longest_us:.0} us")));
            assert_eq!(diagnosis.remedy.is_none(), verdict == Suitability::Well);
        }
    }

    #[test]
    fn each_processor_counts() {
        let folder = tempfile::tempdir().unwrap();
        assert_eq!(diagnosis(&governors(folder.path())).verdict, Suitability::Well);
        for (processor, governor, verdict) in [
            ("cpu0", "performance", Suitability::Well),
            ("cpu1", "performance", Suitability::Well),
            ("cpu2", "powersave", Suitability::Advice),
        ] {
            let place = folder.path().join(processor).join("cpufreq");
            fs::create_dir_all(&place).unwrap();
            fs::write(place.join("scaling_governor"), format!("{governor}\n")).unwrap();
            assert_eq!(diagnosis(&governors(folder.path())).verdict, verdict);
        }
    }
}
