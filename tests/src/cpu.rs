//! CPU time of the processes of a session, from their summaries.

use std::collections::BTreeMap;
use std::fmt;

use serde::{Deserialize, Serialize};

/// CPU time of one process, in mean cores over the session.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct CpuRow {
    /// The process: "server" or a participant's name.
    #[serde(default)]
    pub process: String,
    pub cores: f64,
    pub classes: BTreeMap<String, f64>,
}

/// CPU time in the summary of a client or server (its field `cpu`); `None` without that field.
pub fn cpu_of(process: &str, summary: &impl Serialize) -> Option<CpuRow> {
    let summary = serde_json::to_value(summary).ok()?;
    let row: CpuRow = serde_json::from_value(summary.get("cpu")?.clone()).ok()?;
    Some(CpuRow {
        process: process.to_owned(),
        ..row
    })
}

pub struct CpuTable<'a>(pub &'a [CpuRow]);

impl fmt::Display for CpuTable<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut classes: Vec<&String> = self.0.iter().flat_map(|r| r.classes.keys()).collect();
        classes.sort();
        classes.dedup();
        write!(f, "{:<15}{:>8}", "mean cores", "all")?;
        for class in &classes {
            write!(f, "{class:>12}")?;
        }
        for row in self.0 {
            write!(f, "\n{:<15}{:>8.3}", row.process, row.cores)?;
            for class in &classes {
                match row.classes.get(*class) {
                    Some(cores) => write!(f, "{cores:>12.3}")?,
                    None => write!(f, "{:>12}", "-")?,
                }
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::{CpuTable, cpu_of};

    #[test]
    fn summary_without_cpu_field_has_no_row() {
        let summary = json!({"name": "holder", "cpu": {"cores": 0.27, "classes": {"force": 0.02, "solver": 0.15}}});
        let row = cpu_of("holder", &summary).unwrap();
        assert_eq!((row.cores, row.classes["solver"]), (0.27, 0.15));
        let table = CpuTable(&[row]).to_string();
        assert!(
            table.contains("holder") && table.contains("0.270"),
            "{table}"
        );
        assert_eq!(cpu_of("holder", &json!({"name": "holder"})), None);
        assert_eq!(cpu_of("holder", &json!({"cpu": null})), None);
    }
}
