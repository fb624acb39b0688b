//! Suggests the known name that is nearest to a misspelt one.

use palpate_tissue::material::nearest_name;

/// `; did you mean "..."?`, or an empty string.
pub(crate) fn did_you_mean(word: &str, known: &[&str]) -> String {
    let nearest = nearest_name(word, known.iter().copied());
    nearest.map_or(String::new(), |n| format!("; did you mean \"{n}\"?"))
}

/// A serde error for an unknown key or variant, with a suggestion. serde prints the unknown name first and then
/// the known ones, each in backquotes.
pub(crate) fn with_suggestion(message: &str) -> String {
    let message = message.trim_end();
    let Some(from) = (message.find("unknown field")).or_else(|| message.find("unknown variant"))
    else {
        return message.to_owned();
    };
    let words: Vec<&str> = message[from..].split('`').skip(1).step_by(2).collect();
    match words.split_first() {
        Some((wrong, known)) => format!("{message}{}", did_you_mean(wrong, known)),
        None => message.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::{did_you_mean, with_suggestion};

    #[test]
    fn typing_error_gets_a_suggestion_and_another_word_does_not() {
        let known = ["delay_ms", "loss", "jitter"];
        assert!(did_you_mean("deley_ms", &known).contains("\"delay_ms\""));
        assert!(did_you_mean("los", &known).contains("\"loss\""));
        assert_eq!(did_you_mean("qqqq", &known), "");
        assert_eq!(did_you_mean("", &[]), "");
    }

    #[test]
    fn serde_error_gets_a_suggestion() {
        let said =
            with_suggestion("line 3: unknown field `sede`, expected one of `seed`, `seeds`\n");
        assert!(said.ends_with("did you mean \"seed\"?"), "{said}");
        assert_eq!(with_suggestion("invalid type"), "invalid type");
        assert_eq!(with_suggestion("unknown field"), "unknown field");
    }
}
