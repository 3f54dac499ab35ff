use super::retired::RENAMED;

/// The parser's words for the types of numbers, and the words that replace them in messages.
const NUMBERS: [(&str, &str); 5] = [
    ("expected f64", "expected a number"),
    ("expected u64", "expected a whole number from 0 on"),
    ("expected u32", "expected a whole number from 0 to 4 294 967 295"),
    ("expected u16", "expected a whole number from 0 to 65 535"),
    ("expected u8", "expected a whole number from 0 to 255"),
];

/// The message of an error about TOML, without the names of the program's types. A list of expected
/// names in it has no earlier name of an entry beside the present name.
pub(crate) fn toml_message(error: &toml::de::Error) -> String {
    let mut message = error.to_string().trim_end().to_owned();
    for (kind, words) in NUMBERS {
        if let Some(above) = message.strip_suffix(kind) {
            message = format!("{above}{words}");
        }
    }
    let before = ", expected one of ";
    let Some((above, list)) = message.rsplit_once(before) else { return message };
    let listed: Vec<&str> = list.split(", ").collect();
    let is_earlier = |name: &str| {
        let mut names = RENAMED.into_iter().flat_map(|(_, names)| names);
        names.any(|(earlier, present)| {
            name == format!("`{earlier}`") && listed.contains(&format!("`{present}`").as_str())
        })
    };
    let present: Vec<&str> = listed.iter().copied().filter(|name| !is_earlier(name)).collect();
    format!("{above}{before}{}", present.join(", "))
}
