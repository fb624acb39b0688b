//! Tables for CSV files, the terminal and the page.
//!
//! Displayed numbers have four significant digits. All numbers of a column have the same number of
//! decimals.

use serde_json::{Value, json};

const LIST_MAX: usize = 16;

/// Significant digits of a column's largest number or a single number, and minimum for the column's
/// smallest.
const DIGITS: i32 = 4;
const DIGITS_MIN: i32 = 2;

/// Maximum number of decimals that the smallest number of a column adds.
const MORE_MAX: i32 = 3;

/// A column of a table of JSON objects: heading, path of the figure such as `tick_ms.p99`, and factor of its unit.
pub(super) type Column = (&'static str, &'static str, f64);

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Table {
    pub head: Vec<String>,
    /// Cells of each row, with all digits.
    pub rows: Vec<Vec<String>>,
}

impl Table {
    /// A table without rows; `columns` are separated by commas.
    pub fn new(columns: &str) -> Self {
        Self {
            head: columns.split(',').map(str::to_owned).collect(),
            rows: Vec::new(),
        }
    }

    /// One row per object; a missing figure gives an empty cell.
    pub(super) fn of_objects(objects: &[Value], columns: &[Column]) -> Self {
        let cell = |object: &Value, (_, path, factor): &Column| match path
            .split('.')
            .fold(object, |value, key| &value[key])
        {
            Value::Null => String::new(),
            Value::String(word) => word.clone(),
            Value::Number(n) if *factor != 1.0 => json!(n.as_f64().map(|x| x * factor)).to_string(),
            other => other.to_string(),
        };
        let row = |object| columns.iter().map(|column| cell(object, column)).collect();
        Self {
            head: columns.iter().map(|c| c.0.to_owned()).collect(),
            rows: objects.iter().map(row).collect(),
        }
    }

    pub fn to_csv(&self) -> String {
        let mut writer = csv::Writer::from_writer(Vec::new());
        for row in std::iter::once(&self.head).chain(&self.rows) {
            writer
                .write_record(row)
                .expect("rows are as long as the heading");
        }
        let text = writer.into_inner().expect("memory accepts all bytes");
        String::from_utf8(text).expect("cells are text")
    }

    /// A table for the terminal: words left-aligned, numbers right-aligned.
    pub(super) fn in_columns(&self) -> String {
        let mut rows = self.rows.clone();
        aligned(&mut rows);
        let is_word: Vec<bool> = (0..self.head.len())
            .map(|k| rows.iter().any(|row| is_word(&row[k])))
            .collect();
        rows.insert(0, self.head.clone());
        let width = |k: usize| rows.iter().map(|row| row[k].chars().count()).max();
        let widths: Vec<usize> = (0..self.head.len()).filter_map(width).collect();
        let line = |row: &Vec<String>| {
            let cells = row.iter().zip(&widths).zip(&is_word);
            let cells = cells.map(|((cell, width), is_word)| match is_word {
                true => format!("{cell:<width$}"),
                false => format!("{cell:>width$}"),
            });
            let line = cells.collect::<Vec<_>>().join("  ");
            line.trim_end().to_owned() + "\n"
        };
        rows.iter().map(line).collect()
    }
}

pub(super) fn alone(value: &Value) -> String {
    match value {
        Value::Number(n) if n.is_f64() => n.as_f64().map_or(String::new(), number),
        Value::Bool(yes) => truth(*yes).to_owned(),
        Value::Array(values) => {
            let mut cells: Vec<String> = values.iter().take(LIST_MAX).map(alone).collect();
            if values.len() > LIST_MAX {
                cells.push(format!("… {} in all", values.len()));
            }
            cells.join(", ")
        }
        Value::Null => "–".to_owned(),
        Value::String(word) => word.clone(),
        other => other.to_string(),
    }
}

fn truth(yes: bool) -> &'static str {
    if yes { "yes" } else { "no" }
}

/// A single number with four significant digits.
pub(super) fn number(x: f64) -> String {
    if x == 0.0 {
        return "0".to_owned();
    }
    if !(1e-4..1e7).contains(&x.abs()) {
        return format!("{x:.2e}");
    }
    let digits = decimals(x, DIGITS).clamp(0, 7) as usize;
    format!("{x:.digits$}")
}

/// Decimals that show `digits` significant digits of `x`.
fn decimals(x: f64, digits: i32) -> i32 {
    digits - 1 - x.abs().log10().floor() as i32
}

/// Gives the numbers of each column equal decimals and replaces booleans by yes and no.
pub(super) fn aligned(rows: &mut [Vec<String>]) {
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    for k in 0..columns {
        let numbers: Vec<f64> = (rows.iter())
            .filter_map(|row| row.get(k)?.parse::<f64>().ok())
            .filter(|x| x.is_finite())
            .collect();
        let digits = of_column(&numbers);
        for cell in rows.iter_mut().filter_map(|row| row.get_mut(k)) {
            match (cell.as_str(), cell.parse::<f64>()) {
                ("true", _) => truth(true).clone_into(cell),
                ("false", _) => truth(false).clone_into(cell),
                (_, Ok(x)) if x.is_finite() => *cell = format!("{x:.digits$}"),
                (_, Ok(_)) | ("", Err(_)) => "–".clone_into(cell),
                _ => {}
            }
        }
    }
}

/// Decimals of a column; whole numbers have none.
fn of_column(numbers: &[f64]) -> usize {
    if numbers.iter().all(|x| x.fract() == 0.0) {
        return 0;
    }
    let sizes = || numbers.iter().map(|x| x.abs()).filter(|x| *x > 0.0);
    let largest = decimals(sizes().fold(0.0, f64::max), DIGITS).max(0);
    let smallest = decimals(sizes().fold(f64::INFINITY, f64::min), DIGITS_MIN);
    smallest.clamp(largest, largest + MORE_MAX) as usize
}

/// Whether the cell makes its column a text column.
pub(super) fn is_word(cell: &str) -> bool {
    cell.parse::<f64>().is_err() && cell.chars().any(char::is_alphabetic)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use serde_json::json;

    use super::*;

    #[test]
    fn single_numbers_have_four_significant_digits() {
        let shown = [1234.56, 0.012_345_6, -2.0, 0.0, 1e-9, 3e8].map(number);
        assert_eq!(
            shown,
            ["1235", "0.01235", "-2.000", "0", "1.00e-9", "3.00e8"]
        );
    }

    fn column(cells: &[&str]) -> Vec<String> {
        let mut rows: Vec<Vec<String>> = cells.iter().map(|c| vec![(*c).to_owned()]).collect();
        aligned(&mut rows);
        rows.concat()
    }

    #[test]
    fn numbers_of_a_column_have_equal_decimals() {
        assert_eq!(column(&["0.00361234", "5.10406"]), ["0.0036", "5.1041"]);
        assert_eq!(column(&["1.0000", "64.0000"]), ["1", "64"]);
        assert_eq!(column(&["97.4", "324.1972", "0"]), ["97.4", "324.2", "0.0"]);
        assert_eq!(
            column(&["1e-12", "2.5", "word"]),
            ["0.000000", "2.500000", "word"]
        );
        assert_eq!(column(&["true", "", "NaN"]), ["yes", "–", "–"]);
    }

    #[test]
    fn terminal_tables_align_numbers() {
        let mut table = Table::new("network,sessions,mm");
        for row in [["200 ms, 5 %", "20", "0.05123"], ["lan", "4", "1.25"]] {
            table.rows.push(row.map(str::to_owned).into());
        }
        let shown = table.in_columns();
        let lines: Vec<&str> = shown.lines().collect();
        assert_eq!(lines[1], "200 ms, 5 %        20  0.051");
        assert_eq!(lines[2], "lan                 4  1.250");
        assert_eq!(
            table.to_csv(),
            "network,sessions,mm\n\"200 ms, 5 %\",20,0.05123\nlan,4,1.25\n"
        );
    }

    #[test]
    fn objects_become_rows_by_path_and_factor() {
        let object = json!({ "who": "a", "rate": { "up": 2.5 }, "ok": true, "none": null });
        let columns = [
            ("who", "who", 1.0),
            ("up_k", "rate.up", 2.0),
            ("ok", "ok", 1.0),
            ("none", "none", 1.0),
        ];
        let table = Table::of_objects(&[object], &columns);
        assert_eq!(table.to_csv(), "who,up_k,ok,none\na,5.0,true,\n");
    }

    proptest! {
        #[test]
        fn column_rounding_error_is_bounded_by_the_largest_number(numbers in prop::collection::vec(-1e6..1e6f64, 1..9)) {
            let cells: Vec<String> = numbers.iter().map(ToString::to_string).collect();
            let shown = column(&cells.iter().map(String::as_str).collect::<Vec<_>>());
            for (shown, x) in shown.iter().zip(&numbers) {
                prop_assert!((shown.parse::<f64>().unwrap() - x).abs() <= 5e-4 * numbers.iter().fold(0.0, |a: f64, b| a.max(b.abs())));
            }
        }
    }
}
