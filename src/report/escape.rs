/// Escapes text of any origin for HTML, within an element or within an attribute in double quotes.
/// Characters that [`is_obeyed`] names appear as escapes, except line feeds and tabs.
#[must_use]
pub fn escaped(text: &str) -> String {
    let mut safe = String::with_capacity(text.len() + 16);
    for letter in text.chars() {
        match letter {
            '&' => safe.push_str("&amp;"),
            '<' => safe.push_str("&lt;"),
            '>' => safe.push_str("&gt;"),
            '"' => safe.push_str("&quot;"),
            '\'' => safe.push_str("&#39;"),
            '\n' | '\t' => safe.push(letter),
            _ if is_obeyed(letter) => safe.extend(letter.escape_default()),
            _ => safe.push(letter),
        }
    }
    safe
}

/// Escapes JSON for a script element that holds data: no character is left with which a browser
/// could end the element or begin a comment. The JSON keeps its meaning.
#[must_use]
pub fn inert(json: &str) -> String {
    json.replace('<', "\\u003c").replace('>', "\\u003e").replace('&', "\\u0026")
}

/// Returns whether a browser or terminal acts on the character instead of showing it: Unicode's
/// control characters including C1; line and paragraph separators; characters that change the
/// direction of writing (UAX 9); characters without width; marks of annotations; tags.
#[must_use]
pub fn is_obeyed(letter: char) -> bool {
    letter.is_control()
        || matches!(
            letter,
            '\u{061c}'
                | '\u{180e}'
                | '\u{200b}'..='\u{200f}'
                | '\u{2028}'..='\u{202e}'
                | '\u{2060}'..='\u{206f}'
                | '\u{feff}'
                | '\u{fff9}'..='\u{fffb}'
                | '\u{e0000}'..='\u{e007f}'
        )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_name_becomes_markup() {
        let hostile = "<script>alert('1')</script>\"&\u{202e}\u{1b}\u{0}";
        let safe = escaped(hostile);
        assert!(!safe.contains(['<', '>', '"', '\'', '\u{202e}', '\u{1b}', '\u{0}']), "{safe}");
        assert!(
            safe.starts_with("&lt;script&gt;alert(&#39;1&#39;)") && safe.contains("&amp;"),
            "{safe}"
        );
        assert_eq!(escaped("θ̇ 20 °"), "θ̇ 20 °");
    }

    #[test]
    fn inert_json_means_the_same_and_ends_no_element() {
        let text = "</script><!-- <script>&amp;";
        let json = inert(&serde_json::to_string(text).unwrap());
        assert!(!json.contains(['<', '>', '&']), "{json}");
        assert_eq!(serde_json::from_str::<String>(&json).unwrap(), text);
    }
}
