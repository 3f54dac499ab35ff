use std::fs;
use std::path::Path;

/// Folder in which Linux links serial ports by device name, which does not depend on the order of
/// plugging in.
const BY_ID: &str = "/dev/serial/by-id";

/// The serial ports of this computer by their kernel names.
#[must_use]
pub fn available_ports() -> Vec<String> {
    let ports = serialport::available_ports().unwrap_or_default();
    ports.into_iter().map(|port| port.port_name).collect()
}

/// A name that stays with the device: the given name if it is a link, otherwise the link in
/// `/dev/serial/by-id` if there is one, otherwise the given name.
///
/// A given link (`/dev/serial/by-path`, or one of a udev rule) was chosen for this rig. Boards
/// without a serial number of their own share one name in `by-id`, which may lead to another board
/// after a reset of the hub.
#[must_use]
pub fn stable_port_name(port: &str) -> String {
    linked_name(Path::new(BY_ID), port).unwrap_or_else(|| port.to_owned())
}

fn linked_name(links: &Path, port: &str) -> Option<String> {
    if Path::new(port).is_symlink() {
        return None;
    }
    let target = fs::canonicalize(port).ok()?;
    let mut names: Vec<_> = fs::read_dir(links)
        .ok()?
        .flatten()
        .map(|link| link.path())
        .filter(|link| fs::canonicalize(link).is_ok_and(|path| path == target))
        .collect();
    names.sort();
    names.first()?.to_str().map(str::to_owned)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_port_is_named_by_its_id_where_it_has_one() {
        let folder = tempfile::tempdir().unwrap();
        let (port, other) = (folder.path().join("ttyACM0"), folder.path().join("ttyACM1"));
        fs::write(&port, "").unwrap();
        fs::write(&other, "").unwrap();
        let links = folder.path().join("by-id");
        fs::create_dir(&links).unwrap();
        let link = links.join("usb-Arduino_Uno-if00");
        std::os::unix::fs::symlink(&port, &link).unwrap();
        let name = |port: &Path| linked_name(&links, port.to_str().unwrap());
        assert_eq!(name(&port), Some(link.to_str().unwrap().to_owned()));
        let by_path = folder.path().join("by-path-usb-0:1.4");
        std::os::unix::fs::symlink(&port, &by_path).unwrap();
        assert_eq!((name(&link), name(&by_path)), (None, None), "links are kept as they are given");
        assert_eq!(name(&other), None);
        assert_eq!(linked_name(Path::new("/no/such/folder"), port.to_str().unwrap()), None);
    }
}
