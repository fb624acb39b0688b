//! The processor of a library, from the first bytes of its file (ELF, PE and Mach-O, by their formats).

/// Number of bytes read from a file. The header of a PE file follows a stub that is shorter than this.
pub(super) const HEAD_BYTES: u64 = 1024;

/// The processor in the words of [`std::env::consts::ARCH`]; `None` for other files, and for several processors.
pub(super) fn of(head: &[u8]) -> Option<&'static str> {
    match head.get(..4)? {
        [0x7f, b'E', b'L', b'F'] => Some(of_elf(head)),
        [b'M', b'Z', ..] => of_pe(head),
        [0xcf, 0xfa, 0xed, 0xfe] => Some(match u32_at(head, 4)? {
            0x0100_0007 => "x86_64",
            0x0100_000c => "aarch64",
            _ => "another processor",
        }),
        _ => None,
    }
}

/// Byte 5 is the byte order, the half word at 18 the processor.
fn of_elf(head: &[u8]) -> &'static str {
    let bytes = [18, 19].map(|i| head.get(i).copied().unwrap_or_default());
    let number = if head.get(5) == Some(&2) {
        u16::from_be_bytes(bytes)
    } else {
        u16::from_le_bytes(bytes)
    };
    match number {
        3 => "x86",
        8 => "mips",
        21 => "powerpc64",
        22 => "s390x",
        40 => "arm",
        62 => "x86_64",
        183 => "aarch64",
        243 => "riscv64",
        _ => "another processor",
    }
}

/// The word at 60 is the offset of the header, whose fifth and sixth bytes are the processor.
fn of_pe(head: &[u8]) -> Option<&'static str> {
    let at = u32_at(head, 60)? as usize;
    let header = head.get(at..at.checked_add(6)?)?;
    if header[..4] != *b"PE\0\0" {
        return None;
    }
    Some(match u16::from_le_bytes([header[4], header[5]]) {
        0x014c => "x86",
        0x8664 => "x86_64",
        0xaa64 => "aarch64",
        _ => "another processor",
    })
}

fn u32_at(head: &[u8], at: usize) -> Option<u32> {
    let bytes = head.get(at..at.checked_add(4)?)?;
    Some(u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::of;

    #[test]
    fn this_program_is_for_the_processor_it_runs_on() {
        let mut head = std::fs::read(std::env::current_exe().unwrap()).unwrap();
        head.truncate(1024);
        assert_eq!(of(&head), Some(std::env::consts::ARCH));
    }

    #[test]
    fn headers_of_three_systems_are_read() {
        let mut elf = [0_u8; 64];
        elf[..6].copy_from_slice(b"\x7fELF\x02\x01");
        elf[18] = 183;
        assert_eq!(of(&elf), Some("aarch64"));
        elf[5] = 2;
        elf[18..20].copy_from_slice(&[0, 22]);
        assert_eq!(of(&elf), Some("s390x"));
        let mut pe = [0_u8; 256];
        pe[..2].copy_from_slice(b"MZ");
        pe[60] = 128;
        pe[128..134].copy_from_slice(b"PE\0\0\x4c\x01");
        assert_eq!(of(&pe), Some("x86"));
        assert_eq!(of(b"\xcf\xfa\xed\xfe\x0c\0\0\x01"), Some("aarch64"));
        assert_eq!(of(b"a text file"), None);
    }

    proptest! {
        #[test]
        fn no_file_panics(
            start in prop::sample::select(vec![&b"MZ"[..], b"\x7fELF", b"\xcf\xfa\xed\xfe", b""]),
            rest in prop::collection::vec(any::<u8>(), 0..200),
        ) {
            let _ = of(&[start, &rest].concat());
        }
    }
}
