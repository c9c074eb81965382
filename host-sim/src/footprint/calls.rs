//! What a function calls: branches out of it, decoded from its machine code.
//!
//! Known are the forms that leave a function: with link (a call), without (a tail call), and through a register (an
//! indirect call). Encodings: Arm DDI 0403 (Thumb-2), Arm DDI 0487 (A64).

use super::elf::{Function, InstructionSet};
use std::collections::BTreeSet;

/// Where control goes from a function.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Calls {
    /// Addresses outside of the function.
    pub targets: BTreeSet<u64>,
    /// Jumps through a register or a table of pointers: their targets are not known.
    pub indirect: usize,
}

/// One instruction as far as calls go.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Flow {
    /// Goes on, or returns.
    Next,
    /// To an address, with a way back.
    Call(u64),
    /// To an address.
    Jump(u64),
    /// To wherever a register points.
    Indirect,
}

impl Calls {
    pub fn of(function: &Function<'_>, set: InstructionSet) -> Self {
        let mut calls = Self::default();
        let (start, end) = (function.address, function.address + function.code.len() as u64);
        let mut at = 0;
        while at < function.code.len() {
            if let Some(data) = function.data.iter().find(|data| data.contains(&at)) {
                at = data.end;
                continue;
            }
            let address = start + at as u64;
            let (flow, length) = match set {
                InstructionSet::Thumb => thumb(&function.code[at..], address),
                InstructionSet::A64 if is_table_jump(function, at) => (Flow::Next, 4),
                InstructionSet::A64 => (a64(word(&function.code[at..]), address), 4),
            };
            match flow {
                Flow::Call(target) => drop(calls.targets.insert(target)),
                Flow::Jump(target) if !(start..end).contains(&target) => drop(calls.targets.insert(target)),
                Flow::Jump(_) | Flow::Next => {}
                Flow::Indirect => calls.indirect += 1,
            }
            at += length;
        }
        calls
    }
}

fn half_word(code: &[u8]) -> u32 {
    code.first_chunk().map_or(0, |bytes| u16::from_le_bytes(*bytes).into())
}

fn word(code: &[u8]) -> u32 {
    code.first_chunk().map_or(0, |bytes| u32::from_le_bytes(*bytes))
}

/// `value` of `bits` binary digits with its sign, added to an address.
fn displaced(address: u64, value: u32, bits: u32) -> u64 {
    let offset = (value << (32 - bits)).cast_signed() >> (32 - bits);
    address.wrapping_add_signed(offset.into())
}

/// Flow of the Thumb instruction at the start of `code`, and its length.
fn thumb(code: &[u8], address: u64) -> (Flow, usize) {
    let (pc, first) = (address + 4, half_word(code));
    if first >> 11 < 0b11101 {
        let flow = match first {
            // B, with a condition and without.
            _ if first & 0xF000 == 0xD000 && first & 0x0E00 != 0x0E00 => {
                Flow::Jump(displaced(pc, (first & 0xFF) << 1, 9))
            }
            _ if first & 0xF800 == 0xE000 => Flow::Jump(displaced(pc, (first & 0x7FF) << 1, 12)),
            // BLX; BX, of which that through LR returns; MOV to PC.
            _ if first & 0xFF87 == 0x4780 || first & 0xFF87 == 0x4700 && first & 0x78 != 0x70 => Flow::Indirect,
            _ if first & 0xFF87 == 0x4687 => Flow::Indirect,
            _ => Flow::Next,
        };
        return (flow, 2);
    }
    let second = half_word(code.get(2..).unwrap_or_default());
    let bit = |word: u32, at: u32| word >> at & 1;
    let flow = match second & 0xD000 {
        // B.W and BL: 25 digits, two of them stored inverted where they equal the sign.
        0x9000 | 0xD000 if first & 0xF800 == 0xF000 => {
            let sign = bit(first, 10);
            let (i1, i2) = (1 ^ bit(second, 13) ^ sign, 1 ^ bit(second, 11) ^ sign);
            let value = sign << 24 | i1 << 23 | i2 << 22 | (first & 0x3FF) << 12 | (second & 0x7FF) << 1;
            let target = displaced(pc, value, 25);
            if second & 0xD000 == 0xD000 { Flow::Call(target) } else { Flow::Jump(target) }
        }
        // B.W with a condition.
        0x8000 if first & 0xF800 == 0xF000 && first & 0x0380 != 0x0380 => {
            let value = bit(first, 10) << 20 | bit(second, 11) << 19 | bit(second, 13) << 18;
            Flow::Jump(displaced(pc, value | (first & 0x3F) << 12 | (second & 0x7FF) << 1, 21))
        }
        // LDR to PC; that from the stack returns.
        _ if first & 0xFF70 == 0xF850 && second >> 12 == 15 && (first, second) != (0xF85D, 0xFB04) => Flow::Indirect,
        _ => Flow::Next,
    };
    (flow, 4)
}

/// Flow of an A64 instruction.
fn a64(word: u32, address: u64) -> Flow {
    match word {
        _ if word & 0xFC00_0000 == 0x9400_0000 => Flow::Call(displaced(address, (word & 0x03FF_FFFF) << 2, 28)),
        _ if word & 0xFC00_0000 == 0x1400_0000 => Flow::Jump(displaced(address, (word & 0x03FF_FFFF) << 2, 28)),
        // B.cond, CBZ and CBNZ.
        _ if word & 0xFF00_0010 == 0x5400_0000 || word & 0x7E00_0000 == 0x3400_0000 => {
            Flow::Jump(displaced(address, (word >> 5 & 0x7_FFFF) << 2, 21))
        }
        // TBZ and TBNZ.
        _ if word & 0x7E00_0000 == 0x3600_0000 => Flow::Jump(displaced(address, (word >> 5 & 0x3FFF) << 2, 16)),
        // BLR and BR.
        _ if word & 0xFFDF_FC1F == 0xD61F_0000 => Flow::Indirect,
        _ => Flow::Next,
    }
}

/// Instructions that lie at most between the parts of a jump through a table.
const TABLE_JUMP_REACH: usize = 32;

/// Whether an A64 instruction is the end of a `match`: a BR to a register that holds the sum of an address inside the
/// function (ADR) and an entry of a table (ADD). Anything else that may write the register in between ends the search.
fn is_table_jump(function: &Function<'_>, at: usize) -> bool {
    let last = word(&function.code[at..]);
    if last & 0xFFFF_FC1F != 0xD61F_0000 {
        return false;
    }
    let register = last >> 5 & 31;
    let mut has_sum = false;
    for back in (0..at).rev().step_by(4).map(|end| end - 3).take(TABLE_JUMP_REACH) {
        let word = word(&function.code[back..]);
        let [first, second, third] = [word & 31, word >> 5 & 31, word >> 10 & 31];
        // Loads of pairs and exclusive ones have a second register; elsewhere these digits are a number.
        let is_pair = word & 0x3A00_0000 == 0x2800_0000 || word & 0x3F00_0000 == 0x0800_0000;
        let is_sum = word & 0xFF20_0000 == 0x8B00_0000 && first == register && second == register;
        if word & 0x9F00_0000 == 0x1000_0000 && first == register {
            let value = (word >> 5 & 0x7_FFFF) << 2 | word >> 29 & 3;
            let to = displaced(back as u64, value, 21);
            return has_sum && to < function.code.len() as u64;
        }
        if is_sum && !has_sum {
            has_sum = true;
        } else if [first, second].contains(&register) || is_pair && third == register || a64(word, 0) != Flow::Next {
            return false;
        }
    }
    false
}

#[cfg(test)]
mod tests {
    use super::*;

    /// At 0x1000; encodings by an assembler.
    fn flow_of_thumb(code: &[u8]) -> (Flow, usize) {
        thumb(code, 0x1000)
    }

    #[test]
    fn thumb_branches_are_decoded() {
        assert_eq!(flow_of_thumb(&[0x00, 0xF0, 0x00, 0xF8]), (Flow::Call(0x1004), 4), "bl .+4");
        assert_eq!(flow_of_thumb(&[0xFF, 0xF7, 0xFE, 0xFF]), (Flow::Call(0x1000), 4), "bl .");
        assert_eq!(flow_of_thumb(&[0x00, 0xF0, 0x00, 0xB8]), (Flow::Jump(0x1004), 4), "b.w .+4");
        assert_eq!(flow_of_thumb(&[0xFE, 0xE7]), (Flow::Jump(0x1000), 2), "b .");
        assert_eq!(flow_of_thumb(&[0xFE, 0xD0]), (Flow::Jump(0x1000), 2), "beq .");
        assert_eq!(flow_of_thumb(&[0x88, 0x47]), (Flow::Indirect, 2), "blx r1");
        assert_eq!(flow_of_thumb(&[0x18, 0x47]), (Flow::Indirect, 2), "bx r3");
        assert_eq!(flow_of_thumb(&[0x70, 0x47]), (Flow::Next, 2), "bx lr");
        assert_eq!(flow_of_thumb(&[0x5D, 0xF8, 0x04, 0xFB]), (Flow::Next, 4), "ldr pc, [sp], #4");
        assert_eq!(flow_of_thumb(&[0x53, 0xF8, 0x21, 0xF0]), (Flow::Indirect, 4), "ldr.w pc, [r3, r1, lsl #2]");
        assert_eq!(flow_of_thumb(&[0xDF, 0xE8, 0x00, 0xF0]), (Flow::Next, 4), "tbb [pc, r0]");
    }

    #[test]
    fn a64_branches_are_decoded() {
        assert_eq!(a64(0x9400_0002, 0x1000), Flow::Call(0x1008), "bl .+8");
        assert_eq!(a64(0x17FF_FFFF, 0x1000), Flow::Jump(0xFFC), "b .-4");
        assert_eq!(a64(0x5400_0040, 0x1000), Flow::Jump(0x1008), "b.eq .+8");
        assert_eq!(a64(0xB400_0040, 0x1000), Flow::Jump(0x1008), "cbz x0, .+8");
        assert_eq!(a64(0x3600_0040, 0x1000), Flow::Jump(0x1008), "tbz w0, #0, .+8");
        assert_eq!(a64(0xD63F_0100, 0x1000), Flow::Indirect, "blr x8");
        assert_eq!(a64(0xD61F_0100, 0x1000), Flow::Indirect, "br x8");
        assert_eq!(a64(0xD65F_03C0, 0x1000), Flow::Next, "ret");
    }

    #[test]
    fn a_match_is_no_indirect_call() {
        let indirect = |words: &[u32]| {
            let code: Vec<u8> = words.iter().flat_map(|word| word.to_le_bytes()).collect();
            let function =
                Function { name: "f".into(), address: 0x1000, code: &code, data: Vec::new(), frame: Some(0) };
            Calls::of(&function, InstructionSet::A64).indirect
        };
        // adr x10, .+16; ldrb w11, [x9, x8]; add x10, x10, x11, lsl #2; mov x0, x20; br x10
        let (adr, ldrb, add, mov, br) = (0x1000_008A, 0x3868_692B, 0x8B0B_094A, 0xAA14_03E0, 0xD61F_0140);
        assert_eq!(indirect(&[adr, ldrb, add, mov, br]), 0);
        assert_eq!(indirect(&[adr, ldrb, mov, br]), 1, "no entry of a table");
        assert_eq!(indirect(&[adr, ldrb, add, 0xF940_2BE0, br]), 0, "ldr x0, [sp, #80]: 80 is 8 times 10");
        assert_eq!(indirect(&[adr, ldrb, add, 0xA942_2BEC, br]), 1, "ldp x12, x10, [sp, #32]");
        assert_eq!(indirect(&[ldrb, add, mov, br]), 1, "of an unknown address");
        assert_eq!(indirect(&[adr, ldrb, add, 0xF940_0D0A, br]), 1, "ldr x10, [x8, #24]");
        assert_eq!(indirect(&[0x1001_000A, ldrb, add, mov, br]), 1, "adr x10 beyond the function");
    }
}
