//! Pictures of tissue. A sheet shows a cross-section of a model or the walls of wounds: coloured regions, springs, poor cells,
//! legend and scale. A figure shows panels of surfaces and cross-sections in a row.
//!
//! tiny-skia draws the raster and embedded-graphics provides bitmap fonts. Both are small, need no system library and
//! draw equal bits everywhere.

mod canvas;
mod colour;
mod figure;
mod frame;
mod legend;
mod panel;
mod section;
mod sheet;
mod view;
mod wound;

use std::str::FromStr;

use palpate_tissue::file::ModelFile;
use palpate_tissue::{Model, Topology};

use crate::ServerError;
pub use figure::figure;
pub use panel::Panel;
use section::Section;
pub use view::View;

/// The plane of a cross-section.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Slice {
    /// The axis normal to the plane.
    pub(crate) axis: usize,
    /// Position on the axis in mm; default: the middle of the model.
    pub(crate) at_mm: Option<f64>,
}

impl Default for Slice {
    fn default() -> Self {
        Self {
            axis: 2,
            at_mm: None,
        }
    }
}

impl FromStr for Slice {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong = || {
            format!(
                "invalid slice \"{text}\"; use x, y or z, optionally with a position in mm (z=100)"
            )
        };
        let (axis, at) = match text.split_once('=') {
            Some((axis, at)) => (axis, Some(at)),
            None => (text, None),
        };
        let axis = match axis.trim() {
            "x" | "X" => 0,
            "y" | "Y" => 1,
            "z" | "Z" => 2,
            _ => return Err(wrong()),
        };
        let at_mm = match at.map(|at| at.trim().trim_end_matches("mm").trim().parse::<f64>()) {
            None => None,
            Some(Ok(at)) if at.is_finite() => Some(at),
            Some(_) => return Err(wrong()),
        };
        Ok(Self { axis, at_mm })
    }
}

/// Draws a section as PNG. `name` goes into the title; `springs` draws them however small they are.
pub(crate) fn draw(
    file: &ModelFile,
    name: &str,
    slice: Slice,
    springs: bool,
) -> Result<Vec<u8>, ServerError> {
    let section = Section::through(&file.model, slice).map_err(ServerError::Option)?;
    on_sheet(&file.model, &section, name, springs)
}

/// Draws the walls of the wounds of a topology as PNG, coloured by region; `model` is [`Topology::to_model`] of it. Without
/// a wound it draws the section through the middle.
pub(crate) fn draw_wounds(
    topology: &Topology,
    model: &Model,
    name: &str,
) -> Result<Vec<u8>, ServerError> {
    let section = match wound::walls(topology, model) {
        Some(walls) => walls,
        None => Section::through(model, Slice::default()).map_err(ServerError::Option)?,
    };
    on_sheet(model, &section, name, false)
}

fn on_sheet(
    model: &Model,
    section: &Section,
    name: &str,
    springs: bool,
) -> Result<Vec<u8>, ServerError> {
    sheet::draw(model, section, name, springs)
        .map_err(|what| ServerError::Option(format!("cannot draw the picture: {what}")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use palpate_tissue::{Material, block};

    #[test]
    fn slice_is_an_axis_with_an_optional_position() {
        let slice = |axis, at_mm| Ok(Slice { axis, at_mm });
        assert_eq!("z=580".parse(), slice(2, Some(580.0)));
        assert_eq!("x = -1.5 mm".parse(), slice(0, Some(-1.5)));
        assert_eq!("Y".parse(), slice(1, None));
        for wrong in ["", "w=3", "z=", "z=nan", "z=1=2", "580"] {
            assert!(wrong.parse::<Slice>().is_err(), "{wrong}");
        }
    }

    #[test]
    fn picture_of_every_axis_is_drawn_deterministically() {
        let model = block([7, 3, 4], 0.004, &Material::default(), 1);
        let file = ModelFile {
            model,
            report_json: String::new(),
        };
        for axis in ["x", "y", "z", "z=0", "z=16"] {
            let slice = axis.parse().unwrap();
            let png = draw(&file, "block", slice, true).unwrap();
            assert!(png.starts_with(b"\x89PNG"));
            assert_eq!(png, draw(&file, "block", slice, true).unwrap());
        }
    }

    #[test]
    fn slice_outside_the_model_is_rejected_with_its_extent() {
        let model = block([7, 3, 4], 0.004, &Material::default(), 1);
        let slice = "y=50".parse().unwrap();
        let said = Section::through(&model, slice).unwrap_err();
        assert!(said.contains("0.0 to 12.0 mm"), "{said}");
    }
}
