"""`osf mcp` as an assistant uses it: started by the protocol's own client, in front of a running service."""

import base64
import io
import os
import sys

import anyio
import pytest
from mcp import Client, StdioServerParameters
from PIL import Image

BOX, BOTTLE = "003_cracker_box", "006_mustard_bottle"


def assistant(url, dialogue, *more):
    """Hold a dialogue with the tools in front of the service at an address."""
    command = ["-m", "app.cli", "mcp", "--url", url, *more]
    server = StdioServerParameters(command=sys.executable, args=command, env={"PYTHONPATH": os.getcwd()})

    async def hold():
        async with Client(server) as client:

            async def ask(tool, **arguments):
                answer = await client.call_tool(tool, arguments, progress_callback=progress)
                assert not answer.is_error, answer.content
                value = answer.structured_content
                return answer.content if value is None else value.get("result", value)

            told = []

            async def progress(done, total, note):
                told.append((done, total, note))

            await dialogue(client, ask, told)

    anyio.run(hold)


def size_of(content):
    (picture,) = content
    assert picture.mime_type == "image/png"
    return Image.open(io.BytesIO(base64.b64decode(picture.data))).size


@pytest.mark.slow
def test_a_table_is_looked_at_and_brought_to_its_goal(live, tmp_path):
    async def dialogue(client, ask, told):
        table = await ask("new_table", objects=[BOX, BOTTLE], seed=1)
        assert {BOX, BOTTLE} <= set(await ask("list_objects"))
        (listed,) = (one for one in await ask("list_tables") if one["id"] == table["id"])
        assert listed == table
        assert size_of(await ask("look", size=64)) == (64, 64)
        box = table["objects"][0]
        assert box["name"] == BOX
        goal = await ask("goal_from_poses", objects=[box])  # where it is: no push is needed
        assert goal["problem"] == ""
        assert min(size_of(await ask("goal_picture", goal=goal["id"]))) > 64
        begun = await ask("start_episode", goal=goal["id"], actions=1)
        now = begun
        while not now["is_over"]:
            now = await ask("follow_episode", episode=begun["id"], seconds=60)
        assert (now["status"], now["id"]) == ("done", begun["id"])
        assert now["outcome"]
        assert now["to_goal_mm"][BOX] < 20
        assert told
        assert begun["id"] in [one["id"] for one in await ask("list_episodes")]
        assert size_of(await ask("episode_picture", episode=begun["id"], step=0))
        written = await ask("download", episode=begun["id"], file="report.json", folder=str(tmp_path))
        assert written == str(tmp_path / "report.json")
        assert (tmp_path / "report.json").stat().st_size > 0

    assistant(live.url, dialogue)


@pytest.mark.slow
def test_a_photo_is_a_goal_and_an_episode_is_stopped(live, tmp_path):
    async def dialogue(client, ask, told):
        await ask("new_table", objects=[BOX, BOTTLE], seed=1)
        (picture,) = await ask("look")
        (tmp_path / "photo.png").write_bytes(base64.b64decode(picture.data))
        goal = await ask("goal_from_photo", path=str(tmp_path / "photo.png"))
        assert goal["name"] == "photo"
        begun = await ask("start_episode", goal=goal["id"])
        stopped = await ask("stop_episode", episode=begun["id"])
        while not stopped["is_over"]:
            stopped = await ask("follow_episode", episode=begun["id"], seconds=60)
        assert stopped["status"] == "cancelled"

    assistant(live.url, dialogue)


@pytest.mark.slow
def test_what_goes_wrong_is_told_in_a_sentence(live):
    async def refused(client, ask, told):
        for tool, arguments, word in (
            ("new_table", {"objects": ["teapot"]}, "teapot"),
            ("look", {"table": "none"}, "scene"),
            ("goal_from_photo", {"path": "/nowhere.png"}, "/nowhere.png"),
        ):
            answer = await client.call_tool(tool, arguments)
            assert answer.is_error
            (text,) = (part.text for part in answer.content)
            assert word in text
            assert len(text.splitlines()) == 1

    async def unreached(client, ask, told):
        answer = await client.call_tool("list_tables", {})
        assert answer.is_error
        assert "http://127.0.0.1:9" in answer.content[0].text

    assistant(live.url, refused)
    assistant("http://127.0.0.1:9", unreached, "--token", "secret")


def test_every_tool_and_argument_is_described(live):
    async def dialogue(client, ask, told):
        listed = (await client.list_tools()).tools
        assert len(listed) >= 10
        for tool in listed:
            assert tool.description
            described = [bool(one.get("description")) for one in tool.input_schema["properties"].values()]
            assert all(described), tool

    assistant(live.url, dialogue)
