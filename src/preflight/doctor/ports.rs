use std::fs;
use std::os::unix::fs::{FileTypeExt, MetadataExt};
use std::path::Path;

use rustix::fs::{Access, access};

use super::Diagnosis;
use crate::device::{available_ports, locker_of};
use crate::preflight::latency_timer::{latency_timer_ms, latency_timer_remedy};

/// Names of USB serial ports without their numbers. A Qube is at no other port.
const USB: [&str; 2] = ["ttyUSB", "ttyACM"];

/// Tests these ports, or all USB serial ports if none is given.
pub(super) fn diagnose(ports: &[String]) -> Vec<Diagnosis> {
    let found: Vec<String> = if ports.is_empty() {
        available_ports()
            .into_iter()
            .filter(|port| USB.iter().any(|usb| port.contains(usb)))
            .collect()
    } else {
        ports.to_vec()
    };
    if found.is_empty() {
        let value = "no USB serial port here";
        let remedy = "plug the board in; a cable without data wires shows nothing";
        return vec![Diagnosis::advice("ports", value, remedy)];
    }
    found.iter().flat_map(|port| [Some(permission(port)), timer(port)]).flatten().collect()
}

/// The group that owns a port, for a user who may not open the port.
struct Owner {
    group: String,
    /// True if `/etc/group` lists the user in that group. A listed user who may not open the port
    /// was added after the login.
    is_listed: bool,
}

fn permission(port: &str) -> Diagnosis {
    let name = format!("port {port}");
    let Ok(metadata) = fs::metadata(port) else {
        return Diagnosis::unfit(&name, "does not exist", "plug the board in, or name another");
    };
    if !may_be_serial(&metadata) {
        return Diagnosis::unfit(&name, "is no serial port", "name the Qube's port");
    }
    if access(port, Access::READ_OK | Access::WRITE_OK).is_ok() {
        if let Some(holder) = locker_of(port) {
            let remedy =
                "end that program before you drive the Qube: a port serves one program at a time";
            return Diagnosis::advice(&name, format!("in use by {holder}"), remedy);
        }
        return Diagnosis::well(&name, "may be opened");
    }
    let groups = fs::read_to_string("/etc/group").unwrap_or_default();
    let user = std::env::var("USER").unwrap_or_default();
    refused(&name, &owner(&groups, metadata.gid(), &user))
}

/// Returns whether a file can be a serial port. The test does not open the port, because a
/// connection restarts some boards.
#[must_use]
pub fn may_be_serial(metadata: &fs::Metadata) -> bool {
    // The device number's major part 1 means memory, `/dev/null` and the like.
    metadata.file_type().is_char_device() && rustix::fs::major(metadata.rdev()) != 1
}

fn refused(name: &str, owner: &Owner) -> Diagnosis {
    let group = &owner.group;
    let value = format!("may not be opened: it belongs to the group {group}");
    if owner.is_listed {
        return Diagnosis::unfit(name, value, "you have joined that group: log out and in again");
    }
    if group == "root" {
        let remedy = "let scripts/install put its udev rules in place, or give the port to the group dialout";
        return Diagnosis::unfit(name, value, remedy);
    }
    let remedy = format!("sudo usermod -aG {group} $USER (then log out and in)");
    Diagnosis::unfit(name, value, remedy)
}

/// Reads the group with the number `gid` from lines such as `dialout:x:20:ada,grace`.
fn owner(groups: &str, gid: u32, user: &str) -> Owner {
    let line = groups
        .lines()
        .map(|line| line.split(':').collect::<Vec<_>>())
        .find(|fields| fields.get(2) == Some(&gid.to_string().as_str()));
    let field = |index: usize| line.as_ref().and_then(|fields| fields.get(index)).copied();
    Owner {
        group: field(0).map_or_else(|| gid.to_string(), str::to_owned),
        is_listed: !user.is_empty()
            && field(3).is_some_and(|users| users.split(',').any(|listed| listed == user)),
    }
}

/// The diagnosis of a port's latency timer; `None` if the port has none.
fn timer(port: &str) -> Option<Diagnosis> {
    let file = Path::new(port).file_name()?.to_string_lossy().into_owned();
    let name = format!("timer of {file}");
    Some(match latency_timer_ms(port)? {
        timer_ms if timer_ms <= 1 => Diagnosis::well(&name, format!("{timer_ms} ms")),
        timer_ms => Diagnosis::advice(
            &name,
            format!(
                "set to {timer_ms} ms; this program requests 1 ms when it opens the port, but \
                 not every driver supports this"
            ),
            latency_timer_remedy(port),
        ),
    })
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::super::Suitability;
    use super::*;
    use crate::clock::MonotonicClock;
    use crate::device::SerialLink;
    use crate::device::emulator::{EmulatedQube, EmulatorSettings};

    const GROUPS: &str = "root:x:0:\ndialout:x:20:ada,grace\nplugdev:x:46:\n";

    #[test]
    fn a_refused_port_names_its_group() {
        let remedy = |gid, user| refused("port", &owner(GROUPS, gid, user)).remedy.unwrap();
        assert!(remedy(20, "alan").contains("usermod -aG dialout"));
        assert!(remedy(20, "grace").contains("log out"));
        assert!(remedy(46, "").contains("usermod -aG plugdev"));
        let of_root = remedy(0, "alan");
        assert!(!of_root.contains("usermod") && of_root.contains("udev rules"), "{of_root}");
        assert!(remedy(999, "alan").contains("999"));
    }

    #[test]
    fn a_port_in_use_gives_advice_that_names_its_holder() {
        let qube = EmulatedQube::spawn(EmulatorSettings::default()).unwrap();
        let port = qube.port().to_str().unwrap();
        assert_eq!(permission(port).verdict, Suitability::Well);
        let held = SerialLink::open(port, Arc::new(MonotonicClock)).unwrap();
        let found = permission(port);
        assert_eq!(found.verdict, Suitability::Advice);
        let holder = format!("in use by process {} (", std::process::id());
        assert!(found.value.contains(&holder), "{}", found.value);
        drop(held);
        assert_eq!(permission(port).verdict, Suitability::Well);
    }

    #[test]
    fn a_missing_port_and_other_files_are_unfit() {
        for port in ["/dev/no-such-port", "/dev/null", "/etc/passwd"] {
            let found = diagnose(&[port.to_owned()]);
            assert_eq!(found.len(), 1);
            assert_eq!(found[0].verdict, Suitability::Unfit, "{port}");
        }
    }
}
