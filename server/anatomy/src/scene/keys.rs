//! Walking a parsed TOML table key by key, with the line of every error.

use std::fmt::Display;

use palpate_tissue::material::nearest_name;
use toml::de::{DeTable, DeValue};
use toml::{Spanned, de};

use crate::InputError;

/// The text being read and its name in messages.
pub(super) struct Text<'i> {
    pub(super) file: String,
    pub(super) text: &'i str,
}

impl<'i> Text<'i> {
    /// An error at a byte of the text.
    pub(super) fn error(&self, at: usize, what: impl Display) -> InputError {
        let before = self
            .text
            .as_bytes()
            .get(..at)
            .unwrap_or(self.text.as_bytes());
        let line = before.split(|b| *b == b'\n').count();
        InputError::new(format_args!("{}, line {line}: {what}", self.file))
    }

    /// An error of the TOML parser.
    pub(super) fn syntax(&self, e: &de::Error) -> InputError {
        let at = e.span().map_or(0, |s| s.start);
        self.error(
            at,
            format!("not valid TOML: {}", e.message().replace('\n', ", ")),
        )
    }

    /// Rejects a key that is not in `known`. `place` names the table, such as "in [[region]]".
    pub(super) fn refuse_unknown(
        &self,
        table: &DeTable<'i>,
        known: &[&str],
        place: &str,
    ) -> Result<(), InputError> {
        let stray = table
            .iter()
            .filter(|(key, _)| !known.contains(&key.get_ref().as_ref()))
            .min_by_key(|(key, _)| key.span().start);
        let Some((key, _)) = stray else { return Ok(()) };
        let name = key.get_ref();
        let hint = match nearest_name(name, known.iter().copied()) {
            Some(n) => format!("did you mean \"{n}\"?"),
            None => format!("known are {}", known.join(", ")),
        };
        Err(self.error(
            key.span().start,
            format!("unknown key \"{name}\" {place}; {hint}"),
        ))
    }

    pub(super) fn string(
        &self,
        key: &str,
        value: &Spanned<DeValue<'i>>,
    ) -> Result<String, InputError> {
        value
            .get_ref()
            .as_str()
            .map(str::to_owned)
            .ok_or_else(|| self.kind(key, value, "a text in quotes"))
    }

    /// A number, written with or without a decimal point.
    pub(super) fn number(
        &self,
        key: &str,
        value: &Spanned<DeValue<'i>>,
    ) -> Result<f64, InputError> {
        let number = match value.get_ref() {
            DeValue::Float(f) => f.as_str().parse().ok(),
            DeValue::Integer(i) if i.radix() == 10 => i.as_str().parse().ok(),
            _ => None,
        };
        number.ok_or_else(|| self.kind(key, value, "a number"))
    }

    pub(super) fn boolean(
        &self,
        key: &str,
        value: &Spanned<DeValue<'i>>,
    ) -> Result<bool, InputError> {
        let known = value.get_ref().as_bool();
        known.ok_or_else(|| self.kind(key, value, "true or false"))
    }

    /// An array of values, or of tables.
    pub(super) fn array<'a>(
        &self,
        key: &str,
        value: &'a Spanned<DeValue<'i>>,
        wanted: &str,
    ) -> Result<&'a [Spanned<DeValue<'i>>], InputError> {
        match value.get_ref() {
            DeValue::Array(array) => Ok(array),
            _ => Err(self.kind(key, value, wanted)),
        }
    }

    pub(super) fn table<'a>(
        &self,
        key: &str,
        value: &'a Spanned<DeValue<'i>>,
        wanted: &str,
    ) -> Result<&'a DeTable<'i>, InputError> {
        match value.get_ref() {
            DeValue::Table(table) => Ok(table),
            _ => Err(self.kind(key, value, wanted)),
        }
    }

    fn kind(&self, key: &str, value: &Spanned<DeValue<'i>>, wanted: &str) -> InputError {
        let found = value.get_ref().type_str();
        self.error(
            value.span().start,
            format!("\"{key}\" must be {wanted}, not {found}"),
        )
    }
}
