//! PLY files, ASCII and binary: positions and faces. Polygons become fans; all other elements are skipped.

use std::io::{Cursor, ErrorKind};
use std::path::Path;

use ply_rs_bw::parser::{ParseError, Parser, Reader};
use ply_rs_bw::ply::{
    BeginList, ElementDef, Encoding, Header, PropertyAccess, PropertyAccessResult, PropertyType,
};

use super::read::{broken, not_a_surface, too_many_triangles};
use super::weld::Welder;
use super::{Surface, TRIANGLES_MAX, Unit};
use crate::InputError;

/// Most elements taken from the parser at a time, because each face is a separate allocation there.
const BLOCK: usize = 1 << 16;

/// Names that programs give to a face's list of corners.
const CORNERS: [&str; 2] = ["vertex_indices", "vertex_index"];

/// A vertex or a face, depending on its element; other properties are dropped.
struct Element {
    at: [f32; 3],
    corners: Vec<i64>,
}

/// Accepts the file's number type.
macro_rules! take {
    ($set:ident, $set_list:ident, $begin:ident, $ty:ty) => {
        fn $set(&mut self, name: &str, value: $ty) -> PropertyAccessResult {
            #[allow(clippy::cast_lossless)]
            if let Some(axis) = ["x", "y", "z"].iter().position(|n| *n == name) {
                self.at[axis] = value as f32;
            }
            PropertyAccessResult::Set
        }
        fn $begin(&mut self, _: &str, _: usize) -> BeginList<'_, $ty> {
            BeginList::UseSetter
        }
        fn $set_list(&mut self, name: &str, list: Vec<$ty>) -> PropertyAccessResult {
            #[allow(clippy::cast_lossless)]
            if CORNERS.contains(&name) {
                self.corners = list.into_iter().map(|v| v as i64).collect();
            }
            PropertyAccessResult::Set
        }
    };
}

impl PropertyAccess for Element {
    fn new() -> Self {
        Self {
            at: [f32::NAN; 3],
            corners: Vec::new(),
        }
    }
    take!(set_char, set_list_char, begin_list_char, i8);
    take!(set_uchar, set_list_uchar, begin_list_uchar, u8);
    take!(set_short, set_list_short, begin_list_short, i16);
    take!(set_ushort, set_list_ushort, begin_list_ushort, u16);
    take!(set_int, set_list_int, begin_list_int, i32);
    take!(set_uint, set_list_uint, begin_list_uint, u32);
    take!(set_float, set_list_float, begin_list_float, f32);
    take!(set_double, set_list_double, begin_list_double, f64);
}

/// Reads a file.
pub(super) fn read(path: &Path, bytes: &[u8], unit: Unit) -> Result<Surface, InputError> {
    if !bytes.starts_with(b"ply") {
        return Err(not_a_surface(path, "this is not a PLY file"));
    }
    let mut file = Ply {
        path,
        reader: Reader::new(Cursor::new(bytes)),
        parser: Parser::new(),
    };
    let header = file.parser.read_header(&mut file.reader);
    let header = header.map_err(|e| file.broken("header", &e))?;
    file.refuse_nonsense(&header, bytes.len())?;
    let mut at = Vec::new();
    let mut welder = Welder::new(unit.metres());
    for (name, element) in &header.elements {
        match name.as_str() {
            "vertex" => at = file.vertices(element, &header)?,
            "face" => file.faces(element, &header, &at, &mut welder)?,
            _ => file.each(element, &header, |_, _| Ok(()))?,
        }
    }
    Ok(welder.finish())
}

/// A file while it is read.
struct Ply<'a> {
    path: &'a Path,
    reader: Reader<Cursor<&'a [u8]>>,
    parser: Parser<Element>,
}

impl Ply<'_> {
    fn refuse_nonsense(&self, header: &Header, bytes: usize) -> Result<(), InputError> {
        let left = bytes - (self.reader.get_ref().position() as usize).min(bytes);
        for (name, element) in &header.elements {
            // An element without properties takes a line of its own in a text, and no bytes in a binary file:
            // there its count could be any number.
            let least = match header.encoding {
                Encoding::Ascii => 1,
                _ => element.properties.len(),
            };
            if element.count > 0 && (least == 0 || element.count > left / least) {
                let what = format!(
                    "{} of \"{name:.40}\" declared, but the file has {left} bytes left",
                    element.count
                );
                return Err(self.wrong("header", what));
            }
        }
        let has = |element: &str, property: &[&str], list: bool| {
            let properties = header.elements.get(element).map(|e| &e.properties);
            properties.is_some_and(|p| {
                property.iter().any(|name| {
                    let kind = p.get(*name).map(|p| &p.data_type);
                    kind.is_some_and(|k| matches!(k, PropertyType::List(..)) == list)
                })
            })
        };
        let faces = header.elements.get("face").map_or(0, |f| f.count as u64);
        if faces > TRIANGLES_MAX {
            return Err(too_many_triangles(self.path, faces));
        }
        let all_axes = ["x", "y", "z"].iter().all(|a| has("vertex", &[a], false));
        if !all_axes || !has("face", &CORNERS, true) {
            let what = if header.elements.contains_key("tristrips") {
                "its faces are triangle strips; export them as faces"
            } else {
                "it lacks vertices with x, y and z, or faces with a list vertex_indices (is it a \
                 cloud of points?)"
            };
            return Err(not_a_surface(self.path, what));
        }
        let mut order = header
            .elements
            .keys()
            .filter(|k| *k == "vertex" || *k == "face");
        if order.next().is_some_and(|first| first == "face") {
            let what = "faces stand before vertices".to_owned();
            return Err(self.wrong("header", what));
        }
        Ok(())
    }

    fn vertices(&mut self, def: &ElementDef, header: &Header) -> Result<Vec<[f32; 3]>, InputError> {
        let mut at = Vec::new();
        self.each(def, header, |_, vertex| {
            at.push(vertex.at);
            Ok(())
        })?;
        Ok(at)
    }

    fn faces(
        &mut self,
        def: &ElementDef,
        header: &Header,
        at: &[[f32; 3]],
        welder: &mut Welder,
    ) -> Result<(), InputError> {
        let path = self.path;
        self.each(def, header, |number, face| {
            let wrong = |what: String| broken(path, format!("face {}", number + 1), what);
            if face.corners.len() < 3 {
                let what = format!("a face with {} corners", face.corners.len());
                return Err(wrong(what));
            }
            let corner = |v: i64| {
                let found = usize::try_from(v).ok().and_then(|v| at.get(v));
                found
                    .copied()
                    .ok_or_else(|| wrong(format!("it names vertex {v} of {}", at.len())))
            };
            let first = corner(face.corners[0])?;
            for pair in face.corners[1..].windows(2) {
                welder.triangle([first, corner(pair[0])?, corner(pair[1])?]);
            }
            if welder.triangles() as u64 > TRIANGLES_MAX {
                return Err(too_many_triangles(path, welder.triangles() as u64));
            }
            Ok(())
        })
    }

    /// Calls `take` with every element of a kind and its number.
    fn each(
        &mut self,
        def: &ElementDef,
        header: &Header,
        mut take: impl FnMut(usize, Element) -> Result<(), InputError>,
    ) -> Result<(), InputError> {
        let mut block = def.clone();
        let mut done = 0;
        while done < def.count {
            block.count = BLOCK.min(def.count - done);
            let read = self
                .parser
                .read_payload_for_element(&mut self.reader, &block, header);
            let read = read.map_err(|e| {
                let place = format!(
                    "\"{:.40}\" {} to {}",
                    def.name,
                    done + 1,
                    done + block.count
                );
                self.broken(&place, &e)
            })?;
            for element in read {
                take(done, element)?;
                done += 1;
            }
        }
        Ok(())
    }

    fn broken(&self, place: &str, e: &ParseError) -> InputError {
        let what = match e.kind() {
            ErrorKind::UnexpectedEof => "the file is truncated".to_owned(),
            // The parser repeats the faulty line on a line of its own.
            _ => e
                .to_string()
                .split_whitespace()
                .collect::<Vec<_>>()
                .join(" "),
        };
        self.wrong(place, what.chars().take(200).collect())
    }

    fn wrong(&self, place: &str, what: String) -> InputError {
        broken(self.path, place, what)
    }
}
