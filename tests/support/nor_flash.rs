//! A NOR flash in memory that behaves as badly as the data sheets allow: writes only clear bits, a word is written once
//! after an erase, and a power cut tears the operation that it meets.

use crate::random::Random;
use embedded_storage::nor_flash::{self, NorFlashErrorKind, check_erase, check_read, check_write};
use embedded_storage::nor_flash::{ErrorType, ReadNorFlash};
use firmware::update::MappedFlash;
use model_compiler::emit::AlignedBytes;
use std::ops::Range;

/// What an operation was.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Operation {
    /// Sectors erased.
    Erase(Range<u32>),
    /// Bytes written from an offset on.
    Write(u32, Vec<u8>),
}

/// When an operation is to go wrong, and how.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Trouble {
    /// The power fails during this operation, by number.
    PowerCut(usize),
    /// This operation answers an error and changes nothing.
    Error(usize),
    /// This operation changes nothing and answers that all is well.
    Silence(usize),
}

/// The flash; words of `WRITE` bytes, sectors of `ERASE` bytes.
#[derive(Clone, Debug)]
pub struct NorFlash<const WRITE: usize, const ERASE: usize> {
    bytes: AlignedBytes,
    /// Words that must not be written before their sector is erased.
    used: Vec<bool>,
    operations: Vec<Operation>,
    trouble: Option<Trouble>,
    has_power: bool,
    random: Random,
}

impl<const WRITE: usize, const ERASE: usize> NorFlash<WRITE, ERASE> {
    /// An erased flash of so many sectors; the seed decides how operations are torn.
    pub fn new(sectors: usize, seed: u64) -> Self {
        let mut bytes = AlignedBytes::zeroed(sectors * ERASE);
        bytes.fill(0xFF);
        Self {
            used: vec![false; bytes.len() / WRITE],
            bytes,
            operations: Vec::new(),
            trouble: None,
            has_power: true,
            random: Random::new(seed),
        }
    }

    /// What the flash holds.
    pub fn bytes(&self) -> &[u8] {
        &self.bytes
    }

    /// Puts bytes there as a programmer in the factory would, whatever was there.
    pub fn program(&mut self, offset: u32, bytes: &[u8]) {
        let start = offset as usize;
        self.bytes[start..start + bytes.len()].copy_from_slice(bytes);
        self.used[start / WRITE..(start + bytes.len()).div_ceil(WRITE)].fill(true);
    }

    /// Flips bits of a byte, as age does.
    pub fn flip(&mut self, offset: u32, bits: u8) {
        self.bytes[offset as usize] ^= bits;
    }

    /// Lets words be written twice, for tests of what goes wrong then.
    pub fn forgive(&mut self, range: Range<u32>) {
        self.used[range.start as usize / WRITE..range.end as usize / WRITE].fill(false);
    }

    /// Erases and writes since the power came on, in order; the torn one, too.
    pub fn operations(&self) -> &[Operation] {
        &self.operations
    }

    /// Whether the power is on.
    pub fn has_power(&self) -> bool {
        self.has_power
    }

    /// Switches the power on. The operation of this number, counted from now, will be torn by a power cut.
    pub fn power_on(&mut self, cut: Option<usize>) {
        self.has_power = true;
        self.operations.clear();
        self.trouble = cut.map(Trouble::PowerCut);
    }

    /// The operation of this number, counted from now, will fail: it answers an error, or nothing at all (`silent`).
    pub fn fail(&mut self, operation: usize, silent: bool) {
        self.operations.clear();
        self.trouble = Some(if silent { Trouble::Silence(operation) } else { Trouble::Error(operation) });
    }

    /// Takes note of an operation and says whether it goes on as it should; if not, with what answer it ends.
    fn begin(&mut self, operation: Operation) -> Result<(), Result<(), NorFlashErrorKind>> {
        if !self.has_power {
            return Err(Err(NorFlashErrorKind::Other));
        }
        let number = self.operations.len();
        self.operations.push(operation.clone());
        match self.trouble {
            Some(Trouble::PowerCut(cut)) if cut == number => {
                self.has_power = false;
                self.tear(operation);
                Err(Err(NorFlashErrorKind::Other))
            }
            Some(Trouble::Error(failing)) if failing == number => Err(Err(NorFlashErrorKind::Other)),
            Some(Trouble::Silence(failing)) if failing == number => Err(Ok(())),
            _ => Ok(()),
        }
    }

    /// What a power cut leaves of an operation.
    fn tear(&mut self, operation: Operation) {
        match operation {
            Operation::Erase(range) => {
                let range = range.start as usize..range.end as usize;
                // The manufacturers promise nothing; these are what is seen, the first from a cut that came early.
                let way = self.random.below(6);
                let erased = self.random.below(range.len() + 1);
                for (position, byte) in self.bytes[range.clone()].iter_mut().enumerate() {
                    *byte = match way {
                        0 => *byte,
                        1 => *byte | self.random.bits() as u8,
                        2 if position < erased => 0xFF,
                        3 if position >= erased => 0xFF,
                        2 | 3 => *byte,
                        4 => self.random.bits() as u8,
                        _ => 0xFF,
                    };
                }
                self.used[range.start / WRITE..range.end / WRITE].fill(true);
            }
            Operation::Write(offset, bytes) => {
                let words = self.random.below(bytes.len() / WRITE + 1);
                self.write_words(offset as usize, &bytes[..words * WRITE]);
                if let Some(torn) = bytes[words * WRITE..].chunks(WRITE).next() {
                    let torn: Vec<u8> = torn.iter().map(|byte| byte | self.random.bits() as u8).collect();
                    self.write_words(offset as usize + words * WRITE, &torn);
                }
            }
        }
    }

    fn write_words(&mut self, start: usize, bytes: &[u8]) {
        for (stored, byte) in self.bytes[start..].iter_mut().zip(bytes) {
            *stored &= byte;
        }
        for (used, word) in self.used[start / WRITE..].iter_mut().zip(bytes.chunks(WRITE)) {
            assert!(!*used, "a word at {start:#x} is written twice");
            // A word that no bit was cleared in is as good as erased.
            *used = word.iter().any(|byte| *byte != 0xFF);
        }
    }
}

impl<const WRITE: usize, const ERASE: usize> ErrorType for NorFlash<WRITE, ERASE> {
    type Error = NorFlashErrorKind;
}

impl<const WRITE: usize, const ERASE: usize> ReadNorFlash for NorFlash<WRITE, ERASE> {
    const READ_SIZE: usize = if WRITE < 4 { 1 } else { 4 };

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), NorFlashErrorKind> {
        check_read(self, offset, bytes.len())?;
        if !self.has_power {
            return Err(NorFlashErrorKind::Other);
        }
        bytes.copy_from_slice(&self.bytes[offset as usize..][..bytes.len()]);
        Ok(())
    }

    fn capacity(&self) -> usize {
        self.bytes.len()
    }
}

impl<const WRITE: usize, const ERASE: usize> nor_flash::NorFlash for NorFlash<WRITE, ERASE> {
    const WRITE_SIZE: usize = WRITE;
    const ERASE_SIZE: usize = ERASE;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), NorFlashErrorKind> {
        check_erase(self, from, to)?;
        if let Err(answer) = self.begin(Operation::Erase(from..to)) {
            return answer;
        }
        self.bytes[from as usize..to as usize].fill(0xFF);
        self.used[from as usize / WRITE..to as usize / WRITE].fill(false);
        Ok(())
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), NorFlashErrorKind> {
        check_write(self, offset, bytes.len())?;
        if let Err(answer) = self.begin(Operation::Write(offset, bytes.to_vec())) {
            return answer;
        }
        self.write_words(offset as usize, bytes);
        Ok(())
    }
}

impl<const WRITE: usize, const ERASE: usize> MappedFlash for NorFlash<WRITE, ERASE> {
    fn mapped(&self, range: Range<u32>) -> Option<&[u8]> {
        self.bytes.get(range.start as usize..range.end as usize).filter(|_| self.has_power)
    }
}
