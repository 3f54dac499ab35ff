//! The latency timer of the FTDI driver. The driver holds received bytes back until this timer runs
//! out: 16 ms by default.

use std::fs;
use std::path::{Path, PathBuf};

/// Folder in which Linux shows the settings of serial ports.
const TERMINALS: &str = "/sys/class/tty";

/// The latency timer of a port, ms; `None` if the port has none.
#[must_use]
pub fn latency_timer_ms(port: &str) -> Option<u32> {
    fs::read_to_string(setting(Path::new(TERMINALS), port)?).ok()?.trim().parse().ok()
}

/// The command that sets the timer to 1 ms.
#[must_use]
pub fn latency_timer_remedy(port: &str) -> String {
    match setting(Path::new(TERMINALS), port) {
        Some(path) => format!(
            "echo 1 | sudo tee {} (until it is unplugged; for good: sudo scripts/install)",
            path.display()
        ),
        None => "sudo scripts/install".into(),
    }
}

/// The file with the setting of a port. A link to the port is resolved first, because the folder
/// has the kernel's name of the port.
fn setting(terminals: &Path, port: &str) -> Option<PathBuf> {
    let port = fs::canonicalize(port).ok()?;
    let path = terminals.join(port.file_name()?).join("device/latency_timer");
    path.exists().then_some(path)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_port_is_found_under_its_own_name_and_under_a_link() {
        let folder = tempfile::tempdir().unwrap();
        let device = folder.path().join("sys/ttyUSB7/device");
        fs::create_dir_all(&device).unwrap();
        fs::write(device.join("latency_timer"), "16\n").unwrap();
        let (port, link) = (folder.path().join("ttyUSB7"), folder.path().join("by-id"));
        fs::write(&port, "").unwrap();
        std::os::unix::fs::symlink(&port, &link).unwrap();
        for name in [&port, &link] {
            let found = setting(&folder.path().join("sys"), name.to_str().unwrap());
            assert_eq!(found, Some(device.join("latency_timer")));
        }
        let other = folder.path().join("ttyACM0");
        fs::write(&other, "").unwrap();
        assert_eq!(setting(&folder.path().join("sys"), other.to_str().unwrap()), None);
        assert_eq!(setting(&folder.path().join("sys"), "/dev/no-such-port"), None);
    }
}
