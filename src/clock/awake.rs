use std::fs::{File, OpenOptions};
use std::io::{self, Write};
use std::path::Path;

/// The kernel's file for a bound on the processors' wake-up latency. The bound holds while the file
/// is open (Linux, `Documentation/power/pm_qos_interface.rst`).
pub const CPU_DMA_LATENCY: &str = "/dev/cpu_dma_latency";

/// Requested bound on the wake-up time of a processor, us: 0 keeps it from sleeping.
const WAKE_UP_US: i32 = 0;

/// A request to the kernel that keeps every processor awake. It is in force until this value is
/// dropped or the process ends. A processor that sleeps deeply between two ticks wakes up 0.1 ms
/// late.
#[derive(Debug)]
#[must_use = "the processors may sleep again as soon as it is dropped"]
pub struct AwakeProcessors {
    _request: File,
}

impl AwakeProcessors {
    /// Makes the request through this file, normally [`CPU_DMA_LATENCY`].
    ///
    /// # Errors
    /// The file does not exist (another kernel, or a container) or is not writable.
    pub fn hold(file: &Path) -> io::Result<Self> {
        let mut request = OpenOptions::new().write(true).open(file)?;
        request.write_all(&WAKE_UP_US.to_ne_bytes())?;
        Ok(Self { _request: request })
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// Returns the number of descriptors that this process has open on a file.
    pub(crate) fn openings_of(file: &Path) -> usize {
        let descriptors = std::fs::read_dir("/proc/self/fd").unwrap().flatten();
        descriptors
            .filter(|entry| std::fs::read_link(entry.path()).is_ok_and(|to| to == file))
            .count()
    }

    #[test]
    fn it_writes_zero_and_is_open_until_it_is_dropped() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().canonicalize().unwrap().join("cpu_dma_latency");
        assert_eq!(AwakeProcessors::hold(&file).unwrap_err().kind(), io::ErrorKind::NotFound);
        std::fs::write(&file, "").unwrap();
        let awake = AwakeProcessors::hold(&file).unwrap();
        assert_eq!(std::fs::read(&file).unwrap(), [0; 4]);
        assert_eq!(openings_of(&file), 1);
        drop(awake);
        assert_eq!(openings_of(&file), 0);
    }
}
