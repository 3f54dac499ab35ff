use std::collections::BTreeSet;
use std::path::Path;

/// Returns the names of the files' pictures, without their endings; no two are the same. Where two
/// files share a name, the place of each file in the list, from 0, stands in front of its name.
pub fn picture_names(files: &[&Path]) -> Vec<String> {
    let name = |file: &&Path| file.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let names: Vec<String> = files.iter().map(name).collect();
    if names.iter().collect::<BTreeSet<_>>().len() == names.len() {
        return names;
    }
    names.iter().enumerate().map(|(number, name)| format!("{number}-{name}")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_two_pictures_have_the_same_name() {
        let names =
            |files: &[&str]| picture_names(&files.iter().map(Path::new).collect::<Vec<&Path>>());
        assert_eq!(names(&["x/a.mcap", "y/b.mcap"]), ["a", "b"]);
        assert_eq!(names(&["x/a.mcap", "y/a.mcap"]), ["0-a", "1-a"]);
        assert_eq!(names(&["a.mcap", "a.csv", "0-a.mcap"]), ["0-a", "1-a", "2-0-a"]);
        assert_eq!(names(&["a.mcap", "a.mcap"]), ["0-a", "1-a"]);
    }
}
