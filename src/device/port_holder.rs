use std::fs;
use std::path::Path;

/// Who has this port open, for a message: `process 1234 (name)`, or `another program` where the
/// user may not see it.
pub(super) fn holder_of(port: &str) -> String {
    find_holder(Path::new(port)).unwrap_or_else(|| "another program".to_owned())
}

fn find_holder(port: &Path) -> Option<String> {
    let port = fs::canonicalize(port).ok()?;
    let processes = fs::read_dir("/proc").ok()?.flatten();
    for process in processes {
        let name = process.file_name();
        let Some(pid) = name.to_str().and_then(|name| name.parse::<u32>().ok()) else { continue };
        let Ok(descriptors) = fs::read_dir(process.path().join("fd")) else { continue };
        let has_port = descriptors
            .flatten()
            .any(|descriptor| fs::read_link(descriptor.path()).is_ok_and(|target| target == port));
        if has_port {
            let command = fs::read_to_string(process.path().join("comm")).unwrap_or_default();
            return Some(format!("process {pid} ({})", command.trim()));
        }
    }
    None
}
