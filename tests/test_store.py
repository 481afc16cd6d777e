"""Files that are whole or absent, whatever happens while they are written."""

import errno
import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest
import torch

from prt_torch import store
from prt_torch.errors import InputError

ROWS, PER_SHARD = 10, 4


def values(rows: slice) -> torch.Tensor:
    """Row r is 10 r and the two numbers after it."""
    return torch.arange(rows.start, rows.stop)[:, None] * 10.0 + torch.arange(3.0)


class Maker:
    """Makes blocks and notes which; stops like a user at a block if told to."""

    def __init__(self, stop_at: int | None = None):
        self.made: list[int] = []
        self.stop_at = stop_at

    def __call__(self, rows: slice) -> tuple[dict[str, torch.Tensor], dict[str, float]]:
        if rows.start == self.stop_at:
            raise KeyboardInterrupt
        self.made.append(rows.start)
        tensors = {"values": values(rows), "index": torch.arange(rows.start, rows.stop)}
        return tensors, {"rows": float(rows.stop - rows.start)}


def build(folder: Path | None, make=None, inputs=None, **options) -> store.Sharded:
    return store.build_sharded(
        make or Maker(),
        rows=options.pop("rows", ROWS),
        rows_per_shard=options.pop("rows_per_shard", PER_SHARD),
        inputs=inputs or {"seed": 1},
        folder=folder,
        **options,
    )


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def flip_bit(path: Path, position: int) -> None:
    data = bytearray(path.read_bytes())
    data[position] ^= 1
    path.write_bytes(data)


def full_disk(monkeypatch, *, after: int = 0) -> None:
    """Every write past the first few bytes fails as on a full disk, leaving those bytes."""
    original = Path.write_bytes

    def write(path: Path, data: bytes) -> int:
        original(path, bytes(data)[:after])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_bytes", write)


class TestAtomicWrites:
    @pytest.mark.parametrize("failure", [RuntimeError, KeyboardInterrupt])
    def test_failure_inside_leaves_the_old_file_and_nothing_else(self, tmp_path, failure):
        path = tmp_path / "file"
        store.write_bytes(path, b"old")

        def fail_half_way() -> None:
            with store.replacing(path) as temporary:
                temporary.write_bytes(b"half")
                raise failure

        with pytest.raises(failure):
            fail_half_way()
        assert path.read_bytes() == b"old"
        assert names(tmp_path) == {"file"}

    def test_content_appears_only_at_the_end(self, tmp_path):
        path = tmp_path / "sub" / "file"
        with store.replacing(path) as temporary:
            temporary.write_bytes(b"new")
            assert not path.exists()
            assert temporary.parent == path.parent  # a rename across file systems is not atomic
        assert path.read_bytes() == b"new"
        assert names(path.parent) == {"file"}

    def test_data_are_on_disk_before_the_name_is(self, tmp_path, monkeypatch):
        order = []
        fsync, replace = os.fsync, Path.replace
        monkeypatch.setattr(os, "fsync", lambda fd: (order.append("fsync"), fsync(fd))[1])
        monkeypatch.setattr(
            Path, "replace", lambda a, b: (order.append("rename"), replace(a, b))[1]
        )
        store.write_bytes(tmp_path / "file", b"new")
        assert order == ["fsync", "rename", "fsync"]  # the file, the rename, the folder

    @pytest.mark.parametrize("after", [0, 2])
    def test_full_disk_is_one_line_and_the_old_file_unharmed(self, tmp_path, monkeypatch, after):
        path = tmp_path / "file"
        store.write_bytes(path, b"old")
        full_disk(monkeypatch, after=after)
        with pytest.raises(InputError, match=r"file: cannot be written \(No space left") as caught:
            store.write_json(path, {"new": 1})
        assert "\n" not in str(caught.value)
        assert path.read_bytes() == b"old"
        assert names(tmp_path) == {"file"}

    def test_folder_in_place_of_the_file(self, tmp_path):
        (tmp_path / "file").mkdir()
        with pytest.raises(InputError, match=r"file: cannot be written"):
            store.write_bytes(tmp_path / "file", b"new")
        assert names(tmp_path) == {"file"}

    @pytest.mark.parametrize("value", [float("nan"), float("inf")])
    def test_json_takes_no_nonfinite_numbers(self, tmp_path, value):
        with pytest.raises(ValueError, match="JSON compliant"):
            store.write_json(tmp_path / "file", {"a": [value]})
        assert names(tmp_path) == set()

    @pytest.mark.parametrize("content", [None, b"", b'{"a": ', b"\xff\xfe\x00"])
    def test_unreadable_json_is_one_line(self, tmp_path, content):
        path = tmp_path / "file.json"
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(InputError, match=r"file\.json: ") as caught:
            store.read_json(path)
        assert "\n" not in str(caught.value)


class TestTensors:
    tensors = {  # noqa: RUF012 - never changed
        "a": torch.arange(12.0, dtype=torch.float64).view(3, 4).mT,  # not contiguous
        "b": torch.tensor([1, 2], dtype=torch.int16),
        "c": torch.zeros(0, 3),
    }

    def test_round_trip(self, tmp_path):
        path, metadata = tmp_path / "t", {"x": [1, None, float("inf")], "ü": "=\n"}
        entry = store.write_tensors(path, self.tensors, metadata)
        assert entry == {"bytes": path.stat().st_size, "sha256": store.file_sha256(path)}
        tensors, read = store.read_tensors(path, entry["sha256"])
        assert read == metadata
        assert tensors.keys() == self.tensors.keys()
        for name, tensor in self.tensors.items():
            assert tensors[name].dtype == tensor.dtype
            assert torch.equal(tensors[name], tensor)

    def test_any_flipped_bit_is_detected(self, tmp_path):
        path = tmp_path / "t"
        entry = store.write_tensors(path, self.tensors)
        for position in (0, 9, entry["bytes"] // 2, entry["bytes"] - 1):
            flip_bit(path, position)
            with pytest.raises(InputError, match=r"t: SHA-256 differs"):
                store.read_tensors(path, entry["sha256"])
            flip_bit(path, position)
        store.read_tensors(path, entry["sha256"])

    @pytest.mark.parametrize("damage", ["missing", "empty", "cut", "text", "metadata"])
    def test_damaged_files_without_a_known_hash(self, tmp_path, damage):
        path = tmp_path / "t"
        store.write_tensors(path, self.tensors, {"key": "value"})
        data = path.read_bytes()
        match damage:
            case "missing":
                path.unlink()
            case "empty":
                path.write_bytes(b"")
            case "cut":
                path.write_bytes(data[:-3])
            case "text":
                path.write_text("not tensors, but long enough to look like a header")
            case "metadata":  # the outer header stays whole, the JSON inside it does not
                assert data.count(rb"{\"key\"") == 1
                path.write_bytes(data.replace(rb"{\"key\"", rb"[\"key\""))
        with pytest.raises(InputError, match=r"t: ") as caught:
            store.read_tensors(path)
        assert "\n" not in str(caught.value)


class TestDigest:
    def test_tells_content_shape_type_and_order_apart(self):
        a = torch.arange(6.0)
        some = [
            (a,),
            (a.view(2, 3),),
            (a.double(),),
            (a.flip(0),),
            (a[:3], a[3:]),
            (a[:2], a[2:]),
            ({"a": 1},),
            ({"a": "1"},),
            ("a", 1),
            ("a1",),
        ]
        assert len({store.digest(*parts) for parts in some}) == len(some)

    def test_does_not_depend_on_memory_layout_or_key_order(self):
        a = torch.arange(6.0).view(2, 3)
        assert store.digest(a) == store.digest(a.mT.contiguous().mT) == store.digest(a.numpy())
        assert store.digest({"a": 1, "b": 2}) == store.digest({"b": 2, "a": 1})


class TestShardedTensor:
    def test_every_slice_equals_that_of_the_whole(self, tmp_path):
        sharded = build(tmp_path / "f").tensors["values"]
        whole = values(slice(0, ROWS))
        assert sharded.shape == (ROWS, 3)
        assert sharded.dtype == whole.dtype
        for start in (*range(ROWS + 1), None, -3):
            for stop in (*range(ROWS + 2), None, -2):
                assert torch.equal(sharded[start:stop], whole[start:stop]), (start, stop)
        with pytest.raises(ValueError, match="step 1"):
            sharded[::2]

    def test_memory_and_disk_agree(self, tmp_path):
        on_disk, in_memory = build(tmp_path / "f"), build(None)
        assert on_disk.counts == in_memory.counts == {"rows": ROWS}
        assert not on_disk.cached
        assert not in_memory.cached
        for name in ("values", "index"):
            assert torch.equal(on_disk.tensors[name][:], in_memory.tensors[name])

    def test_flipped_bit_is_detected_when_its_block_is_read(self, tmp_path):
        sharded = build(tmp_path / "f").tensors["values"]
        flip_bit(tmp_path / "f" / store.shard_name(1), -1)
        assert torch.equal(sharded[0:4], values(slice(0, 4)))
        with pytest.raises(InputError, match=r"shard-000001\.safetensors: SHA-256 differs"):
            sharded[0:5]

    @pytest.mark.parametrize("damage", ["missing", "short"])
    def test_missing_or_short_block(self, tmp_path, damage):
        build(tmp_path / "f")
        path = tmp_path / "f" / store.shard_name(2)
        if damage == "missing":
            path.unlink()
        else:
            path.write_bytes(path.read_bytes()[:-1])
        with pytest.raises(InputError, match=r"shard-000002\.safetensors: missing, or not"):
            store.ShardedTensor(tmp_path / "f", "values")

    def test_incomplete_or_missing_manifest(self, tmp_path):
        with pytest.raises(KeyboardInterrupt):
            build(tmp_path / "f", Maker(stop_at=8))
        with pytest.raises(InputError, match="f: not complete; run the bake again"):
            store.ShardedTensor(tmp_path / "f", "values")
        (tmp_path / "f" / store.MANIFEST).unlink()
        with pytest.raises(InputError, match=r"manifest\.json: cannot be read"):
            store.ShardedTensor(tmp_path / "f", "values")


class TestBuildSharded:
    def test_finished_is_not_made_again(self, tmp_path):
        first, second, told = Maker(), Maker(), []
        build(tmp_path / "f", first)
        again = build(tmp_path / "f", second, progress=lambda *done: told.append(done))
        assert first.made == [0, 4, 8]
        assert second.made == []
        assert again.cached
        assert again.counts == {"rows": ROWS}
        assert told == [(4, 10), (8, 10), (10, 10)]

    def test_stopped_build_goes_on_where_it_was(self, tmp_path):
        with pytest.raises(KeyboardInterrupt):
            build(tmp_path / "f", Maker(stop_at=8))
        second = Maker()
        built = build(tmp_path / "f", second)
        assert second.made == [8]
        assert not built.cached
        build(tmp_path / "g")
        for path in (tmp_path / "g").iterdir():
            assert (tmp_path / "f" / path.name).read_bytes() == path.read_bytes(), path.name

    def test_lost_and_shortened_blocks_are_made_again(self, tmp_path):
        build(tmp_path / "f")
        (tmp_path / "f" / store.shard_name(0)).unlink()
        short = tmp_path / "f" / store.shard_name(2)
        short.write_bytes(short.read_bytes()[:-1])
        second = Maker()
        built = build(tmp_path / "f", second)
        assert second.made == [0, 8]
        assert torch.equal(built.tensors["values"][:], values(slice(0, ROWS)))

    @pytest.mark.parametrize(
        "change", [{"inputs": {"seed": 2}}, {"rows": 9}, {"rows_per_shard": 5}]
    )
    def test_other_inputs_take_nothing_over(self, tmp_path, change):
        build(tmp_path / "f")
        second = Maker()
        built = build(tmp_path / "f", second, **change)
        rows = change.get("rows", ROWS)
        assert len(second.made) == -(-rows // change.get("rows_per_shard", PER_SHARD))
        assert torch.equal(built.tensors["values"][:], values(slice(0, rows)))

    def test_temporary_of_a_killed_writer_is_removed(self, tmp_path):
        (tmp_path / "f").mkdir()
        (tmp_path / "f" / ".writing-99-shard-000000.safetensors").write_bytes(b"half")
        build(tmp_path / "f")
        assert names(tmp_path / "f") == {store.MANIFEST, *(store.shard_name(i) for i in range(3))}

    def test_waits_for_another_holder(self, tmp_path):
        second = Maker()
        waiting = threading.Thread(target=build, args=(tmp_path / "f", second))
        with store.locked(tmp_path / "f"):
            waiting.start()
            waiting.join(0.3)
            assert waiting.is_alive()
            assert second.made == []
        waiting.join(10)
        assert not waiting.is_alive()
        assert second.made == [0, 4, 8]

    def test_full_disk_keeps_the_blocks_before(self, tmp_path, monkeypatch):
        with pytest.raises(KeyboardInterrupt):
            build(tmp_path / "f", Maker(stop_at=8))
        before = {path.name: path.read_bytes() for path in (tmp_path / "f").iterdir()}
        with monkeypatch.context() as patch:
            full_disk(patch, after=10)
            with pytest.raises(InputError, match=r"shard-000002.*No space left"):
                build(tmp_path / "f")
        assert {path.name: path.read_bytes() for path in (tmp_path / "f").iterdir()} == before
        third = Maker()
        build(tmp_path / "f", third)
        assert third.made == [8]

    def test_damaged_manifest_names_itself(self, tmp_path):
        build(tmp_path / "f")
        (tmp_path / "f" / store.MANIFEST).write_text('{"inputs"')
        with pytest.raises(InputError, match=r"manifest\.json: not a JSON file"):
            build(tmp_path / "f")

    def test_manifest_lists_sizes_and_hashes(self, tmp_path):
        build(tmp_path / "f")
        manifest = json.loads((tmp_path / "f" / store.MANIFEST).read_text())
        assert manifest["inputs"] == {"seed": 1}
        assert manifest["complete"] is True
        for name, entry in manifest["shards"].items():
            path = tmp_path / "f" / name
            assert entry["bytes"] == path.stat().st_size
            assert entry["sha256"] == store.file_sha256(path)


class TestLocked:
    def test_second_holder_is_told(self, tmp_path):
        with (
            store.locked(tmp_path / "f"),
            pytest.raises(InputError, match="f: output folder is in use by another run"),
            store.locked(tmp_path / "f", what="output folder"),
        ):
            pass
        with store.locked(tmp_path / "f"):
            pass  # free again

    def test_lock_ends_with_its_process_however_that_ends(self, tmp_path):
        (tmp_path / "f").mkdir()
        code = (
            "import fcntl, os, sys, time\n"
            "fcntl.flock(os.open(sys.argv[1], os.O_RDONLY), fcntl.LOCK_EX)\n"
            "print('held', flush=True)\n"
            "time.sleep(60)"
        )
        command = [sys.executable, "-c", code, str(tmp_path / "f")]
        holder = subprocess.Popen(command, stdout=subprocess.PIPE)
        try:
            assert holder.stdout.readline() == b"held\n"
            with pytest.raises(InputError, match="in use"), store.locked(tmp_path / "f"):
                pass
        finally:
            holder.send_signal(signal.SIGKILL)
            holder.wait()
            holder.stdout.close()
        with store.locked(tmp_path / "f"):
            pass

    def test_folder_made_for_nothing_is_removed(self, tmp_path):
        with pytest.raises(RuntimeError), store.locked(tmp_path / "f"):
            raise RuntimeError
        assert names(tmp_path) == set()

    def test_folder_with_something_written_stays(self, tmp_path):
        with store.locked(tmp_path / "f"):
            store.write_bytes(tmp_path / "f" / "file", b"new")
        assert names(tmp_path / "f") == {"file"}

    def test_folder_that_was_there_stays(self, tmp_path):
        (tmp_path / "f").mkdir()
        with store.locked(tmp_path / "f"):
            pass
        assert (tmp_path / "f").is_dir()

    def test_waiting_for_a_folder_that_its_holder_removes(self, tmp_path):
        # The lock of the removed folder would keep nobody out of the new one.
        held, result = threading.Event(), []

        def wait() -> None:
            with store.locked(tmp_path / "f", wait=True) as folder:
                held.set()
                try:
                    with store.locked(folder):
                        result.append("entered twice")
                except InputError:
                    result.append("kept out")

        waiting = threading.Thread(target=wait)
        with store.locked(tmp_path / "f"):
            waiting.start()
            assert not held.wait(0.3)
        waiting.join(10)
        assert result == ["kept out"]

    def test_file_in_its_place_and_name_too_long(self, tmp_path):
        (tmp_path / "f").write_bytes(b"")
        for folder in (tmp_path / "f", tmp_path / "f" / "g", tmp_path / ("g" * 300)):
            with (
                pytest.raises(InputError, match="output folder cannot be made"),
                store.locked(folder, what="output folder"),
            ):
                pass
        assert names(tmp_path) == {"f"}

    @pytest.mark.skipif(os.geteuid() == 0, reason="root may write into read-only folders")
    def test_read_only_folder(self, tmp_path):
        (tmp_path / "f").mkdir(mode=0o555)
        with pytest.raises(InputError, match="not writable"), store.locked(tmp_path / "f"):
            pass

    def test_folder_without_write_access(self, tmp_path, monkeypatch):
        # As above for root, whom the file system itself does not stop.
        monkeypatch.setattr(os, "access", lambda *_: False)
        with (
            pytest.raises(InputError, match="f: bake is not writable"),
            store.locked(tmp_path / "f", what="bake"),
        ):
            pass
        assert names(tmp_path) == set()
