"""fetch_captures against a local server: python3 -m unittest discover datasets-scripts"""

import contextlib
import dataclasses
import hashlib
import io
import json
import shutil
import sys
import unittest
import zipfile
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

sys.path.insert(0, str(Path(__file__).parent))
import fetch_captures
from captures_server import SCENE, FetchTest, Server, archive
from downloads import FetchError


def link(name):
    entry = zipfile.ZipInfo(name)
    entry.external_attr = 0o120777 << 16
    return entry


# Contents of the Tanks and Temples archives: INRIA's also contains Deep Blending, and GOF's contains further scenes.
TANKS = {
    "/x/tandt_db.zip": archive(SCENE),
    "/x/TNT_GOF.zip": archive([(f"{s}/sparse/0/cameras.bin", b"c") for s in fetch_captures.OF_GOF]),
}


class Fetch(FetchTest):
    def test_unpacks_and_names_the_command(self):
        self.assertIn("train", self.fetch())
        self.assertEqual((self.folder / "tandt_db/tandt/truck/images/000001.jpg").read_bytes(), SCENE[1][1])
        self.fetch()
        self.assertEqual(len(Server.requests), 1, "a second run downloads nothing")

    def test_a_scene_that_is_half_unpacked_is_none(self):
        extract = fetch_captures.extract

        def interrupted(source, entry, target):
            if entry.filename.endswith(".jpg"):
                raise KeyboardInterrupt
            extract(source, entry, target)

        with mock.patch.object(fetch_captures, "extract", side_effect=interrupted), self.assertRaises(KeyboardInterrupt):
            self.fetch()
        self.assertTrue((self.folder / "tandt_db/tandt/truck/sparse/0").is_dir())
        with self.assertRaisesRegex(FetchError, "found none in tandt/truck"), contextlib.redirect_stdout(io.StringIO()):
            fetch_captures.say_commands("tandt_db", ["tandt/truck"], self.folder / "tandt_db")
        self.assertIn("tandt/truck", self.fetch())

    def test_no_temporary_files_are_left(self):
        def hidden():
            return [p.name for p in (self.folder / "tandt_db").rglob(".fetch-captures-*")]

        Server.content = self.damaged()
        self.refused("Bad CRC-32")
        self.assertEqual(hidden(), [])
        # Left by a killed run.
        (self.folder / "tandt_db/tandt/truck/.fetch-captures-x").touch()
        (self.folder / "archives/tandt_db.zip").unlink()
        Server.content = archive(SCENE)
        self.fetch()
        self.assertEqual(hidden(), [])

    def test_archives_can_be_deleted(self):
        self.assertIn("archives takes 0.0 GB; its archives can be deleted", self.fetch())
        (self.folder / "archives/tandt_db.zip").unlink()
        Server.requests = []
        with mock.patch("shutil.disk_usage", return_value=SimpleNamespace(free=0)):
            self.assertIn("train", self.fetch())
        self.assertEqual(Server.requests, [], "what is whole is not downloaded again")
        (self.folder / "tandt_db/tandt/truck/images/000001.jpg").unlink()
        self.fetch(scenes=["train"])
        self.assertEqual(Server.requests, [])
        self.fetch()
        self.assertEqual(len(Server.requests), 1, "what is not, is")

    def test_scenes_of_an_earlier_version_stay_and_are_named(self):
        self.assertNotIn("not verified", self.fetch())
        (self.folder / "archives/tandt_db.zip").unlink()
        for scene in ("tandt/truck", "db/playroom"):
            (self.folder / "tandt_db" / scene / fetch_captures.MARKER).unlink()
        Server.requests, before = [], (self.folder / "tandt_db/scenes.json").read_text()
        note = "Note: not verified, because an earlier version of this program unpacked them: tandt/truck, db/playroom; "
        self.assertIn(note, self.fetch())
        # Also where they are not chosen.
        self.assertIn(note, self.fetch(scenes=["train"]))
        self.assertEqual((Server.requests, (self.folder / "tandt_db/scenes.json").read_text()), ([], before))
        for text in ("", "[]", '{"scenes": {"truck": 1}}', '{"scenes": {"truck": {"capture": []}}}'):
            (self.folder / "tandt_db/scenes.json").write_text(text)
            self.assertFalse(fetch_captures.is_there("tandt/truck", self.folder / "tandt_db"), text)
        self.assertNotIn("not verified", self.fetch())
        self.assertEqual((len(Server.requests), (self.folder / "tandt_db/scenes.json").read_text()), (1, before))

    def test_no_two_commands_write_one_file(self):
        for name, collection in fetch_captures.CAPTURES.items():
            files = {f"{scene}/sparse/0/cameras.bin": 0 for scene in collection.scenes}
            for file in files:
                (self.folder / name / file).parent.mkdir(parents=True)
                (self.folder / name / file).touch()
            fetch_captures.mark(collection.scenes, self.folder / name, files)
            printed = io.StringIO()
            with contextlib.redirect_stdout(printed):
                fetch_captures.say_commands(name, list(collection.scenes), self.folder / name)
            outputs = [line.split(" -o ")[1].split()[0].lower() for line in printed.getvalue().splitlines() if " -o " in line]
            self.assertEqual(sorted(set(outputs)), sorted(outputs), name)
        tables = [table for collection in fetch_captures.CAPTURES.values() for table in collection.tables]
        self.assertTrue({*tables}.isdisjoint(fetch_captures.CAPTURES), "a table of some scenes beside that of all")

    def test_compares_with_the_first_download(self):
        self.fetch()
        (self.folder / "archives/tandt_db.zip").unlink()
        (self.folder / "tandt_db/tandt/truck" / fetch_captures.MARKER).unlink()
        (self.folder / "tandt_db/scenes.json").unlink()
        Server.content = archive(SCENE[:1])
        self.refused("SHA-256.*SHA256SUMS says .*; delete it and run again")

    def test_no_entry_leaves_the_folder(self):
        for name in ("../out.txt", "/tmp/out.txt", "a/../../out.txt", "..\\out.txt", "c:out.txt"):
            with self.subTest(name):
                Server.content = archive([SCENE[0], (name, b"x")])
                self.refused("leaves the folder")
                self.assertFalse((self.folder / "tandt_db/tandt").exists(), "nothing of a bad archive is unpacked")
                (self.folder / "archives/tandt_db.zip").unlink()
                self.assertFalse((self.folder / "archives/SHA256SUMS").exists())

    def test_links_are_refused(self):
        Server.content = archive([(link("tandt/away"), "/etc")])
        self.refused("not a regular file")

    def test_old_link_in_the_folder(self):
        outside = self.folder / "outside"
        outside.mkdir()
        (self.folder / "tandt_db").mkdir()
        (self.folder / "tandt_db/tandt").symlink_to(outside)
        self.refused("leads out")
        self.assertEqual(list(outside.iterdir()), [])

    def test_a_damaged_archive_is_not_what_later_ones_must_match(self):
        whole, Server.content = Server.content, self.damaged()
        self.refused("Bad CRC-32.*; delete it and run again")
        (self.folder / "archives/tandt_db.zip").unlink()
        Server.content = whole
        self.fetch()

    def damaged(self):
        whole = archive(SCENE)
        place = whole.index(SCENE[1][1]) + 1000
        return whole[:place] + b"!" + whole[place + 1 :]

    def test_a_damaged_archive_is_not_recorded_beside_files_of_its_size(self):
        self.fetch()
        marker = f"tandt_db/tandt/truck/{fetch_captures.MARKER}"
        for name in ("archives/tandt_db.zip", "archives/SHA256SUMS", marker, "tandt_db/scenes.json"):
            (self.folder / name).unlink()
        Server.content = self.damaged()
        self.refused("Bad CRC-32.*; delete it and run again")
        self.assertFalse((self.folder / "archives/SHA256SUMS").exists())

    def test_a_damaged_archive_is_not_recorded_for_its_other_scenes(self):
        Server.content = self.damaged()
        self.refused("Bad CRC-32.*; delete it and run again", "tandt_db", ["train"])
        self.assertFalse((self.folder / "archives/SHA256SUMS").exists())

    def test_files_of_equal_size_are_compared_before_an_archive_is_recorded(self):
        file = self.folder / "tandt_db/tandt/truck/images/000001.jpg"
        file.parent.mkdir(parents=True)
        file.write_bytes(bytes(len(SCENE[1][1])))
        self.fetch()
        self.assertEqual(file.read_bytes(), SCENE[1][1])
        # An archive that is known to be intact is not read again.
        with mock.patch.object(fetch_captures, "crc32", side_effect=AssertionError):
            self.fetch()

    def test_lines_of_checksums_that_say_nothing_are_passed_over(self):
        (self.folder / "archives").mkdir()
        (self.folder / "archives/SHA256SUMS").write_text("\nnonsense\n")
        self.fetch()

    def test_scenes_that_an_archive_lacks_are_named(self):
        Server.content = archive(SCENE[:2] + [(f"other/{n}", c) for n, c in SCENE[2:]])
        self.refused("found none in tandt/train, db/drjohnson, db/playroom")

    def test_commands_can_be_pasted(self):
        self.folder = self.folder / "my captures"
        self.assertIn(f"centaur train '{self.folder}/tandt_db/tandt/truck' -o truck.glb\n", self.fetch())

    def test_not_a_zip(self):
        Server.content = b"<html>moved</html>"
        self.refused("not a zip")

    def test_a_small_disk_is_found_before_any_download(self):
        with mock.patch("shutil.disk_usage", return_value=SimpleNamespace(free=int(1.5 * len(Server.content)))):
            self.refused("needs .* GB for archives and")
            self.assertEqual(Server.requests, [])
            # The size of chosen scenes is unknown before the archive is there.
            self.fetch(scenes=["train"])
        (self.folder / "archives/tandt_db.zip").unlink()
        with mock.patch("shutil.disk_usage", return_value=SimpleNamespace(free=3 * len(Server.content))):
            self.fetch()

    def test_what_is_there_needs_no_space(self):
        self.fetch()
        with mock.patch("shutil.disk_usage", return_value=SimpleNamespace(free=0)):
            self.fetch()

    def test_says_where_the_licence_stands(self):
        self.assertIn("https://www.tanksandtemples.org/license/", self.fetch())
        for name, collection in fetch_captures.CAPTURES.items():
            self.assertGreater(len(collection.licence), 20, name)

    def test_only_chosen_scenes(self):
        Server.content = archive([*SCENE, ("readme.txt", b"r")])
        printed = self.fetch(scenes=["train"])
        self.assertFalse((self.folder / "tandt_db/tandt/truck").exists())
        self.assertTrue((self.folder / "tandt_db/readme.txt").exists(), "what belongs to no scene")
        self.assertIn("tandt/train", printed)
        self.assertNotIn("tandt/truck", printed)
        self.refused("expected truck, train, drjohnson, playroom, found barn", "tandt_db", ["barn"])

    def main(self, *arguments, name="tandt_db"):
        """Exit status and error output."""
        said = io.StringIO()
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(said):
            try:
                fetch_captures.main([name, str(self.folder), *arguments])
            except SystemExit as end:
                return (1, end.code) if isinstance(end.code, str) else (end.code, said.getvalue())
        return 0, said.getvalue()

    def test_names_of_scenes_are_stripped_and_an_empty_one_is_none(self):
        with mock.patch.object(fetch_captures, "download", side_effect=AssertionError):
            for names in ("", " ", "train,", ","):
                self.assertEqual(
                    self.main("--scenes", names), (1, "error: --scenes: expected truck, train, drjohnson, playroom, found nothing")
                )
        mirror = f"http://127.0.0.1:{self.server.server_port}/x"
        self.assertEqual(self.main("--mirror", mirror, "--scenes", " train , playroom")[0], 0)
        self.assertTrue((self.folder / "tandt_db/db/playroom").exists())
        self.assertFalse((self.folder / "tandt_db/tandt/truck").exists())

    def test_addresses(self):
        for mirror in ("", "foo", "http://[::1"):
            expected = f"error: --mirror: expected an address such as https://host/folder, found {mirror or 'nothing'}"
            self.assertEqual(self.main("--mirror", mirror), (1, expected))
        self.assertEqual(list(self.folder.iterdir()), [])
        self.assertRegex(self.main("--mirror", "http://127.0.0.1:port")[1], "^error: .*tandt_db.zip: nonnumeric port: 'port'$")

    def test_an_interruption_is_one_line(self):
        with mock.patch.object(fetch_captures, "download", side_effect=KeyboardInterrupt):
            self.assertEqual(self.main("--mirror", "http://127.0.0.1:9"), (130, "error: stopped; the same command goes on\n"))

    def test_published_checksum(self):
        collection = fetch_captures.CAPTURES["tandt_db"]
        for found, content in ((True, Server.content), (False, b"other")):
            sums = {"tandt_db.zip": hashlib.sha256(content).hexdigest()}
            with mock.patch.dict(fetch_captures.CAPTURES, tandt_db=dataclasses.replace(collection, sums=sums)):
                self.fetch() if found else self.refused("its publisher says")

    def test_synthetic_scenes_are_archives_of_their_own(self):
        views = [(f"lego/{part}/r_0.png", b"p") for part in ("train", "test")]
        Server.content = archive(
            [("lego/transforms_train.json", b"{}"), ("lego/transforms_test.json", b"{}"), ("__MACOSX/lego/._r", b"m")] + views
        )
        printed = self.fetch("nerf_synthetic", ["lego"])
        self.assertEqual(Server.paths, ["/x/lego.zip"])
        folder = self.folder / "nerf_synthetic"
        self.assertEqual(sorted(p.name for p in folder.iterdir()), ["lego", "scenes.json"])
        self.assertIn(f"centaur train {folder / 'lego'} --background white -o lego.glb", printed)
        self.assertIn(f"centaur bench {folder} -o out/nerf_synthetic\n", printed)
        listed = json.loads((folder / "scenes.json").read_text())["scenes"]
        self.assertEqual(listed, {"lego": {"capture": "lego", "flags": ["--background", "white"]}})

    def test_a_synthetic_scene_without_test_views_is_none(self):
        Server.content = archive([("lego/transforms_train.json", b"{}")])
        self.refused("found none in lego", "nerf_synthetic", ["lego"])

    def tanks(self, scenes=None):
        """Fetches Tanks and Temples, for which the test's archive has another checksum than the real one."""
        collection = dataclasses.replace(fetch_captures.CAPTURES["tandt"], sums={})
        with mock.patch.dict(fetch_captures.CAPTURES, tandt=collection):
            return self.fetch("tandt", scenes)

    def captures(self):
        return sorted(str(p.parent.parent.relative_to(self.folder / "tandt")) for p in self.folder.glob("tandt/**/sparse/0"))

    def test_truck_and_train_come_with_tanks_and_temples(self):
        Server.contents = TANKS
        printed = self.tanks()
        self.assertEqual(sorted(Server.paths), sorted(TANKS))
        larger = sorted(fetch_captures.OF_GOF)
        self.assertEqual(self.captures(), larger + ["tandt/train", "tandt/truck"], "Deep Blending stays in its archive")
        folder = self.folder / "tandt"
        self.assertIn(f"centaur train {folder / larger[0]} --downscale 2 -o", printed)
        self.assertIn(f"centaur train {folder / 'tandt/train'} -o", printed)
        self.assertIn(f"centaur bench {folder} -o out/tandt\n", printed)
        self.assertIn(f"centaur bench {folder} --scenes truck,train -o out/truck-and-train\n", printed)
        self.assertIn(f"centaur bench {folder} --scenes Barn,Caterpillar,Ignatius,truck,train -o out/five\n", printed)
        listed = json.loads((folder / "scenes.json").read_text())["scenes"]
        self.assertEqual(listed["Barn"], {"capture": "TNT_GOF/TrainingSet/Barn", "flags": ["--downscale", "2"]})
        self.assertEqual(listed["truck"], {"capture": "tandt/truck", "flags": []})
        self.assertIn("Truck-larger", listed, "files of truck and Truck would be one where case does not count")
        self.assertEqual(len(listed), 8)
        # Both archives are recorded, and not downloaded again, neither under this name nor for the other collection
        # that uses INRIA's archive.
        names = [line.split()[1] for line in (self.folder / "archives/SHA256SUMS").read_text().splitlines()]
        self.assertEqual(sorted(names), ["TNT_GOF.zip", "tandt_db.zip"])
        Server.paths = []
        self.tanks()
        self.assertIn("db/playroom", self.fetch())
        self.assertEqual(Server.paths, [])

    def test_truck_and_train_come_with_any_scene_of_tanks_and_temples(self):
        Server.contents = TANKS
        printed = self.tanks(["Barn"])
        self.assertIn("--scenes truck,train", printed)
        self.assertNotIn("Ignatius", printed)
        self.assertEqual(self.captures(), ["TNT_GOF/TrainingSet/Barn", "tandt/train", "tandt/truck"])

    def test_scenes_are_named_as_in_the_list_of_them(self):
        Server.contents = TANKS
        for name in ("Truck-larger", "Truck"):
            self.assertIn("-o Truck-larger.glb", self.tanks([name]))
            self.assertIn("TNT_GOF/TrainingSet/Truck", self.captures())
            shutil.rmtree(self.folder / "tandt")
        with self.assertRaisesRegex(FetchError, "expected truck, train, Barn, .*, Truck-larger, found lorry"):
            self.tanks(["lorry"])

    def test_truck_and_train_alone_need_one_archive(self):
        Server.contents = TANKS
        self.tanks(["train"])
        self.assertEqual(Server.paths, ["/x/tandt_db.zip"], "of 650 MB, not of 8 GB")
        self.assertEqual(self.captures(), ["tandt/train", "tandt/truck"])

    def test_tanks_and_temples_need_space_for_both_archives(self):
        Server.contents = TANKS
        both = sum(map(len, TANKS.values()))
        with mock.patch("shutil.disk_usage", return_value=SimpleNamespace(free=2 * both - 1)):
            with self.assertRaisesRegex(FetchError, "needs .* GB for archives"):
                self.tanks()
        self.assertEqual(Server.paths, [])

    def test_tanks_and_temples_go_on_where_they_stopped(self):
        Server.contents, Server.cut = TANKS, 60_000
        with self.assertRaisesRegex(FetchError, "tandt_db.zip.*run again to resume"):
            self.tanks()
        Server.cut = None
        self.tanks()
        self.assertEqual(Server.requests, [None, "bytes=60000-", None])

    def test_no_archive_without_a_chosen_scene(self):
        for scene, file in (("flowers", "360_extra_scenes.zip"), ("room", "360_v2.zip")):
            Server.paths, Server.content = [], archive([(f"{scene}/sparse/0/cameras.bin", b"c")])
            self.fetch("mipnerf360", [scene])
            self.assertEqual(Server.paths, [f"/x/{file}"])

    def test_flags_are_those_of_published_tables(self):
        scenes = fetch_captures.CAPTURES["mipnerf360"].scenes
        self.assertEqual(
            {s for s, flags in scenes.items() if flags == "--downscale 4"}, {"bicycle", "flowers", "garden", "stump", "treehill"}
        )
        self.assertEqual({s for s, flags in scenes.items() if flags == "--downscale 2"}, {"room", "counter", "kitchen", "bonsai"})
        for name in ("tandt_db", "tandt"):
            flags = [fetch_captures.CAPTURES[name].scenes[s] for s in ("tandt/truck", "tandt/train")]
            self.assertEqual(flags, ["", ""], f"{name}: at the size that they come in")


if __name__ == "__main__":
    unittest.main()
