use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

use super::Diagnosis;

const NAME: &str = "processor";

/// Where Linux shows its processors.
const PROCESSORS: &str = "/sys/devices/system/cpu";

/// A processor that saves power wakes up late.
pub(super) fn governor() -> Diagnosis {
    judge(&governors(Path::new(PROCESSORS)))
}

fn governors(processors: &Path) -> BTreeSet<String> {
    let Ok(entries) = fs::read_dir(processors) else { return BTreeSet::new() };
    entries
        .flatten()
        .filter_map(|entry| fs::read_to_string(entry.path().join("cpufreq/scaling_governor")).ok())
        .map(|governor| governor.trim().to_owned())
        .collect()
}

fn judge(governors: &BTreeSet<String>) -> Diagnosis {
    let named = governors.iter().cloned().collect::<Vec<_>>().join(", ");
    if governors.is_empty() {
        return Diagnosis::well(NAME, "its governor cannot be seen here (a virtual machine?)");
    }
    if named == "performance" {
        return Diagnosis::well(NAME, "governor performance");
    }
    Diagnosis::advice(
        NAME,
        format!("governor {named}: it may sleep deeply between ticks"),
        "sudo cpupower frequency-set -g performance (until the next start)",
    )
}

#[cfg(test)]
mod tests {
    use super::super::Fitness;
    use super::*;

    #[test]
    fn each_processor_counts() {
        let folder = tempfile::tempdir().unwrap();
        assert_eq!(judge(&governors(folder.path())).verdict, Fitness::Well);
        for (processor, governor, verdict) in [
            ("cpu0", "performance", Fitness::Well),
            ("cpu1", "performance", Fitness::Well),
            ("cpu2", "powersave", Fitness::Advice),
        ] {
            let place = folder.path().join(processor).join("cpufreq");
            fs::create_dir_all(&place).unwrap();
            fs::write(place.join("scaling_governor"), format!("{governor}\n")).unwrap();
            assert_eq!(judge(&governors(folder.path())).verdict, verdict);
        }
    }
}
